"""A flight as one HTML file that needs no network: its data, and the panel's own web components.

The recording's MAVLink messages (for a table, those of its fusion) update the panel's own state of
an aircraft, whose columns are stored as differences of integers. Data and scripts are compressed;
the browser unpacks them and runs the scripts as modules.
"""

import base64
import gzip
import html
import json
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

import numpy as np

from gateway import __version__
from gateway.analysis.flight import FlightTrack, FloatArray, tracks_by_estimator
from gateway.analysis.metrics import euler_rad
from gateway.analysis.processes import begin_copy
from gateway.panel.state.history import FlightHistory
from gateway.panel.state.vehicle import VehicleState
from gateway.printable import printable, reason_of
from gateway.recordings.files import FlightError
from gateway.recordings.recorded_table import ReadOptions
from gateway.recordings.recording import open_recordings
from gateway.recordings.tallies import FACT_IDS, VehicleTally
from gateway.recordings.vehicle_reader import VehicleMessage
from gateway.recordings.workshop.convert import FlightToWrite
from gateway.units import US_PER_S
from gateway.vehicle_state.positions import Continuity
from gateway.wire.mavlink_messages import MESSAGE_IDS, MESSAGE_NAMES

WEB: Final = Path(__file__).parent / "web"
COMPONENTS: Final = (
    "flight_display.js", "flight_scene.js", "flight_map.js", "number_strip.js", "flight_plots.js",
    "flight_page.js",
)  # fmt: skip
"""Components of the panel; the last one contains the others."""
STEP_US: Final = 250_000
"""Interval of the states in the page, which interpolates between them."""
COMPARED_STEP_US: Final = US_PER_S // 2
MAX_ROWS: Final = 80_000
"""Maximum states of one aircraft: more than five hours; of a longer flight every n-th is kept."""
MAX_TEXTS: Final = 2000
READ: Final = frozenset(
    MESSAGE_IDS[name]
    for name in (
        "HEARTBEAT", "ATTITUDE", "ATTITUDE_QUATERNION", "GLOBAL_POSITION_INT", "GPS_RAW_INT",
        "VFR_HUD", "HOME_POSITION", "BATTERY_STATUS", "SYS_STATUS", "GPS_GLOBAL_ORIGIN",
        "ESTIMATOR_STATUS", "NAV_CONTROLLER_OUTPUT",
    )
)  # fmt: skip
"""Messages from which a state is built."""
RESOLUTION: Final = {
    "lat_deg": 1e-6, "lon_deg": 1e-6, "q_nb.0": 5e-4, "q_nb.1": 5e-4, "q_nb.2": 5e-4,
    "q_nb.3": 5e-4, "fix_type": 1.0, "satellites": 1.0, "heading_deg": 1.0, "battery_v": 0.01,
    "battery_percent": 1.0,
}  # fmt: skip
DEFAULT_RESOLUTION: Final = 0.1
"""Resolution of the other columns, m or m/s."""
FACTS: Final = ("distance_m", "airborne_s", "highest_m", "height_above")
LEFT_OUT: Final = frozenset(
    {*(f"rate_b_radps.{n}" for n in range(3)), *(f"vel_n_mps.{n}" for n in range(3))}
)
"""Columns that only serve to extrapolate."""
LIBRARIES: Final = {
    "vue": ("static/vue.esm-browser.prod.js", "Vue 3, (c) Yuxi Evan You and contributors, MIT"),
    "nicegui-scene": (
        "elements/scene/dist/index.js",
        "three.js, (c) three.js authors, MIT, as NiceGUI, (c) Zauberzeug GmbH, MIT, bundles it",
    ),
    "nicegui-leaflet": (
        "elements/leaflet/dist/index.js",
        "Leaflet, (c) Volodymyr Agafonkin, CloudMade and contributors, BSD-2-Clause",
    ),
}
"""File below NiceGUI's folder, and licence, by the name that the components import."""
LEAFLET_CSS: Final = "elements/leaflet/dist/leaflet/leaflet.css"


@dataclass(slots=True)
class _Flown:
    """One aircraft of a flight."""

    vehicle: VehicleState
    tally: VehicleTally
    track: Continuity = field(default_factory=Continuity)
    breaks: list[int] = field(default_factory=list)
    """Times at which its track begins again after an interruption, µs."""

    def __post_init__(self) -> None:
        self.vehicle.history = FlightHistory(MAX_ROWS)

    def add(self, message: VehicleMessage) -> None:
        self.tally.update(message)
        vehicle, time_us = self.vehicle, message.time_us
        if message.text is not None:
            return
        vehicle.state.update(MESSAGE_NAMES[message.message_id], message.fields, time_us)
        if (at := message.position) is None or vehicle.state.position is None:
            return
        if time_us - vehicle.history.newest_us < STEP_US and len(vehicle.history):
            return
        if self.track.is_broken_at(time_us, at.lat_deg, at.lon_deg, message.boot_us):
            self.breaks.append(time_us)
        vehicle.history.add(time_us, vehicle.instant(time_us))


@dataclass(slots=True)
class PageFlight:
    """Data of a flight that a page shows."""

    name: str
    begin_us: int = 0
    """Civil time of the first state, in µs since 1970; 0 if unknown."""
    aircraft: dict[int, _Flown] = field(default_factory=dict)
    texts: list[tuple[int, int, int, str]] = field(default_factory=list)
    """Time in µs, system id, severity and text of each STATUSTEXT."""
    compared: dict[str, dict[str, FloatArray]] = field(default_factory=dict)
    """Columns by estimator: `time_us`, `roll_deg`, `pitch_deg`, `yaw_deg`, `alt_amsl_m`."""
    remarks: list[str] = field(default_factory=list)


def read_flight(files: Sequence[Path], options: ReadOptions, name: str) -> PageFlight:
    """Read a recording in any format that can be played.

    Raises FlightError if it contains no position; OSError if it cannot be read.
    """
    flight = PageFlight(name)
    recorded = FlightToWrite(open_recordings(files), options)
    for message in recorded.vehicle_messages(READ | FACT_IDS):
        system_id = message.system_id
        if system_id not in flight.aircraft:
            tally = VehicleTally(recorded.senders.vehicle(system_id))
            flight.aircraft[system_id] = _Flown(VehicleState(system_id, "recorded"), tally)
        flight.aircraft[system_id].add(message)
        if (text := message.text) is not None and len(flight.texts) < MAX_TEXTS:
            flight.texts.append((message.time_us, system_id, text.severity, text.text))
    flight.remarks += recorded.remarks
    flight.aircraft = {
        key: one for key, one in sorted(flight.aircraft.items()) if len(one.vehicle.history) > 1
    }
    if not flight.aircraft:
        raise FlightError(f"{name}: it contains no position, so there is no flight to show")
    flight.begin_us = min(one.vehicle.history.time_us[0] for one in flight.aircraft.values())
    return flight


def begin_comparison(files: Sequence[Path], options: ReadOptions) -> Connection:
    """Fuse the sensor data of a recording with every estimator, in a separate process."""
    return begin_copy(_compare, (files, options))


def add_comparison(flight: PageFlight, compared: Connection) -> None:
    """Wait for a comparison, and add it, or else a remark with the reason why there is none."""
    try:
        unix_us_at_zero, tracks = compared.recv()
    except EOFError:
        unix_us_at_zero, tracks = "its process has ended", {}
    if isinstance(unix_us_at_zero, str):
        flight.remarks.append(f"The estimators are not compared: {unix_us_at_zero}")
        return
    zero_us = flight.begin_us - unix_us_at_zero
    flight.compared = {name: _compared(track, zero_us) for name, track in tracks.items()}


def _compare(argument: tuple[Sequence[Path], ReadOptions], sender: Connection) -> None:
    """Send the civil time of clock time zero and the tracks, or the reason why there are none."""
    try:
        sender.send(tracks_by_estimator(*argument, COMPARED_STEP_US))
    except (FlightError, OSError, ValueError) as error:
        sender.send((reason_of(error), {}))


def _compared(track: FlightTrack, zero_us: int) -> dict[str, FloatArray]:
    angles = np.degrees(euler_rad(track.q_nb))
    return {
        "time_us": (track.time_us - zero_us).astype(float),
        "roll_deg": angles[:, 0],
        "pitch_deg": angles[:, 1],
        "yaw_deg": angles[:, 2] % 360.0,
        "alt_amsl_m": track.alt_amsl_m,
    }


def render_page(flight: PageFlight) -> str:
    """Return the HTML of a page."""
    packed = {"data": _packed(json.dumps(_data_of(flight), separators=(",", ":")))}
    folder = _nicegui_folder()
    modules = {name: folder / file for name, (file, _) in LIBRARIES.items()}
    modules |= {f"./{name}": WEB / name for name in COMPONENTS}
    sources = {name: path.read_text() for name, path in modules.items()}
    packed["modules"] = _packed(json.dumps(sources))
    css = "\n".join(
        [
            # These rules use no images.
            re.sub(r"url\([^)]*\)", "none", (folder / LEAFLET_CSS).read_text()),
            (WEB / "panel.css").read_text(),
        ]
    )
    licences = "; ".join(licence for _, licence in LIBRARIES.values())
    template = (WEB / "flight_page.html").read_text()
    values = {
        "title": html.escape(printable(flight.name)),
        "version": html.escape(__version__),
        "licences": html.escape(licences),
        "css": css,
        "bus": (WEB / "telemetry_bus.js").read_text(),
        **packed,
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda match: values[match[1]], template)


def _data_of(flight: PageFlight) -> dict[str, Any]:
    zero_us = flight.begin_us
    return {
        "name": printable(flight.name),
        "begin_us": zero_us,
        "aircraft": [
            {
                "system_id": system_id,
                "title": printable(one.vehicle.name),
                "model": one.vehicle.model,
                "battery_name": one.vehicle.battery_name,
                "home": _spot(one.vehicle.home),
                "columns": dict(_columns_of(one.vehicle.history, zero_us)),
                "breaks": [time_us - zero_us for time_us in one.breaks],
                **{fact: getattr(one.tally.facts(), fact) for fact in FACTS},
            }
            for system_id, one in flight.aircraft.items()
        ],
        "texts": [
            [(time_us - zero_us) / US_PER_S, system_id, severity, printable(text)]
            for time_us, system_id, severity, text in flight.texts
        ],
        "compared": {
            name: {key: _differences(values, _resolution(key)) for key, values in columns.items()}
            for name, columns in flight.compared.items()
        },
        "remarks": [printable(remark) for remark in flight.remarks],
    }


def _spot(spot: Any) -> dict[str, float] | None:
    if spot is None or not math.isfinite(spot.lat_deg):
        return None
    return {"lat_deg": spot.lat_deg, "lon_deg": spot.lon_deg, "alt_amsl_m": spot.alt_amsl_m}


def _columns_of(history: FlightHistory, zero_us: int) -> Iterator[tuple[str, Any]]:
    yield "time_us", _differences(np.array(history.time_us, float) - zero_us, 1000.0)
    for name, column in history.columns.items():
        values = np.array(column, float)
        if name not in LEFT_OUT and np.isfinite(values).any():
            yield name, _differences(values, _resolution(name))


def _resolution(name: str) -> float:
    return 1000.0 if name == "time_us" else RESOLUTION.get(name, DEFAULT_RESOLUTION)


def _differences(values: FloatArray, resolution: float) -> dict[str, Any]:
    """Encode a column: `d`, differences in units of `r`; null where it is unknown."""
    counts = np.round(np.where(np.isfinite(values), values, 0.0) / resolution).astype(np.int64)
    known = np.isfinite(values)
    found: list[int | None] = []
    last = 0
    for count, is_known in zip(counts.tolist(), known.tolist(), strict=True):
        found.append(count - last if is_known else None)
        last = count if is_known else last
    return {"r": resolution, "d": found}


def _packed(text: str) -> str:
    return base64.b64encode(gzip.compress(text.encode(), 9, mtime=0)).decode()


def _nicegui_folder() -> Path:
    """Return the folder of NiceGUI, without importing it, which takes a second."""
    spec = find_spec("nicegui")
    if spec is None or not spec.submodule_search_locations:
        raise ModuleNotFoundError("No module named 'nicegui'", name="nicegui")
    return Path(next(iter(spec.submodule_search_locations)))
