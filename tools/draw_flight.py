"""Draw docs/flight.png: what a ground station receives of the built-in simulated flight."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from gateway.cli.live.demo import calibrated_aircraft
from gateway.config import GatewaySettings
from gateway.geometry.geodesy import displacement_m
from gateway.geometry.quaternion import to_euler
from gateway.pipeline import Pipeline, PipelineSettings
from gateway.simulator.flight import SimulatedAircraft
from gateway.simulator.receiver import simulate
from gateway.simulator.trajectory import FLIGHT_S
from gateway.units import DEG_PER_DEGE7, US_PER_S

mpl.use("Agg")
import matplotlib.pyplot as plt

TARGET = Path(__file__).resolve().parent.parent / "docs" / "flight.png"
BLUE, ORANGE, GREY = "#0072b2", "#d55e00", "#888888"
"""Okabe and Ito's colours, which people with colour blindness can distinguish."""


def fly(settings: GatewaySettings) -> dict[str, np.ndarray]:
    """Send the flight through the gateway; rows of (time, figures) by message name."""
    pipeline = Pipeline(PipelineSettings(settings.default_aircraft, calibrated_aircraft(settings)))
    parser = mavlink.MAVLink(None)
    rows: dict[str, list[tuple[float, ...]]] = {"fix": [], "place": [], "attitude": []}
    for frame in simulate(settings.simulator).frames(FLIGHT_S):
        for sent in pipeline.feed(frame.data, round(frame.time_s * US_PER_S)).frames:
            m = parser.decode(bytearray(sent.frame))
            if m.get_type() == "GPS_RAW_INT" and m.fix_type >= mavlink.GPS_FIX_TYPE_3D_FIX:
                rows["fix"].append(
                    (m.time_usec / 1e6, m.lat * DEG_PER_DEGE7, m.lon * DEG_PER_DEGE7)
                )
            elif m.get_type() == "GLOBAL_POSITION_INT":
                place = (m.lat * DEG_PER_DEGE7, m.lon * DEG_PER_DEGE7, m.alt / 1e3)
                rows["place"].append((m.time_boot_ms / 1e3, *place))
            elif m.get_type() == "ATTITUDE":
                rows["attitude"].append((m.time_boot_ms / 1e3, m.roll, m.pitch, m.yaw))
    return {name: np.array(values) for name, values in rows.items()}


def main() -> None:
    """Fly, and draw the track and the attitude with the true ones."""
    settings = GatewaySettings()
    seen = fly(settings)
    home = (settings.simulator.home_lat_deg, settings.simulator.home_lon_deg)
    truth = SimulatedAircraft(settings.simulator).trajectory.truth_at(seen["attitude"][:, 0])
    truth_deg = np.degrees([to_euler(tuple(q)) for q in truth.q_nb])
    figure, panels = plt.subplot_mosaic(
        [["map", "roll"], ["map", "height"]], figsize=(11, 5), width_ratios=[1, 1.15]
    )
    north_east, track = (
        np.array([displacement_m(*home, lat, lon, 0.0) for lat, lon in seen[name][:, 1:3]])
        for name in ("fix", "place")
    )
    panels["map"].plot(*north_east.T[::-1], ".", ms=3, color=GREY, label="GPS fixes, 5 Hz")
    panels["map"].plot(*track.T[::-1], color=BLUE, label="GLOBAL_POSITION_INT")
    panels["map"].plot(0, 0, "^", color=ORANGE, label="home")
    panels["map"].set(xlabel="east of home, m", ylabel="north of home, m", aspect="equal")
    panels["roll"].plot(seen["attitude"][:, 0], truth_deg[:, 0], color=GREY, lw=3, label="truth")
    roll_deg = np.degrees(seen["attitude"][:, 1])
    panels["roll"].plot(seen["attitude"][:, 0], roll_deg, color=BLUE, lw=1, label="ATTITUDE")
    panels["roll"].set(ylabel="roll, deg")
    panels["height"].plot(seen["attitude"][:, 0], truth.alt_amsl_m, color=GREY, lw=3, label="truth")
    panels["height"].plot(
        seen["place"][:, 0], seen["place"][:, 3], color=BLUE, lw=1, label="GLOBAL_POSITION_INT"
    )
    panels["height"].set(xlabel="time, s", ylabel="height AMSL, m")
    for name, panel in panels.items():
        panel.grid(alpha=0.3)
        if name != "map":
            panel.legend(fontsize=8, loc="best")
    # Above the track, which leaves no room for it.
    panels["map"].legend(fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3)
    figure.suptitle("218 s of the simulated flight, as a ground station receives it")
    figure.tight_layout()
    figure.savefig(TARGET, dpi=100)
    print(f"written: {TARGET}")


if __name__ == "__main__":
    main()
