"""Send a real flight through the whole gateway and score what a ground station would see.

The log becomes the simulated receiver's frames; ATTITUDE_QUATERNION and GLOBAL_POSITION_INT that
come out are compared with the log's reference and with its GPS fixes. By default the frames go
through the pipeline as fast as it can; with --real-time through `mavgate demo`, a pseudo-terminal
and a UDP socket, at true rates.
"""

import argparse
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pymavlink.dialects.v20 import common as mavlink
from rich import box
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.spatial.transform import Rotation, Slerp

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from gateway.config import GatewaySettings
from gateway.geometry.angle import wrap_pi
from gateway.pipeline import Pipeline, PipelineSettings
from gateway.recordings.flown import open_flown
from gateway.recordings.fuse import with_reference
from gateway.recordings.reading import ReadOptions
from gateway.simulator.recorded import replay
from gateway.units import DEG_PER_DEGE7, US_PER_S
from tools.flights import Flight, north_east_m, read_flight

FINAL_HEARTBEATS = 5
"""So many heartbeats without an attitude between them: the log has ended."""
MAX_START_S = 1.0
"""The daemon's clock starts at most so long before the log."""


def through_pipeline(file: Path) -> Iterator[mavlink.MAVLink_message]:
    """Give the messages of a log that is pushed through the stages without waiting."""
    settings = GatewaySettings()
    log = open_flown([file], ReadOptions(PipelineSettings(settings.default_aircraft)))
    aircraft = with_reference(settings.default_aircraft, gps_latency_s=log.gps_latency_s)
    pipeline = Pipeline(PipelineSettings(aircraft))
    parser = mavlink.MAVLink(None)
    frames = list(replay(settings.simulator, log).frames(log.duration_s))
    for frame in track(frames, "fusing"):
        for sent in pipeline.feed(frame.data, round(frame.time_s * US_PER_S)).frames:
            yield parser.decode(bytearray(sent.frame))


def through_sockets(file: Path) -> Iterator[mavlink.MAVLink_message]:
    """Give the messages that arrive on a UDP port from `mavgate demo --flight`."""
    parser = mavlink.MAVLink(None)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        endpoint = f"udp:127.0.0.1:{sock.getsockname()[1]}"
        command = [
            "-m",
            "gateway.cli",
            "demo",
            "--plain",
            "--no-panel",
            "--endpoint",
            endpoint,
            "--flight",
        ]
        process = subprocess.Popen([sys.executable, *command, str(file)])
        silent = 0
        try:
            while silent < FINAL_HEARTBEATS:
                for message in parser.parse_buffer(sock.recv(2048)) or []:
                    kind = message.get_type()
                    silent = 0 if kind == "ATTITUDE_QUATERNION" else silent + (kind == "HEARTBEAT")
                    yield message
        finally:
            process.terminate()
            process.wait(10)


def collect(messages: Iterator[mavlink.MAVLink_message]) -> tuple[np.ndarray, np.ndarray]:
    """Sort what is scored into arrays: (time, w, x, y, z) and (time, lat, lon)."""
    attitude, place = [], []
    for m in messages:
        if m.get_type() == "ATTITUDE_QUATERNION":
            attitude.append((m.time_boot_ms / 1e3, m.q1, m.q2, m.q3, m.q4))
        elif m.get_type() == "GLOBAL_POSITION_INT":
            where = (m.lat * DEG_PER_DEGE7, m.lon * DEG_PER_DEGE7)
            place.append((m.time_boot_ms / 1e3, *where))
    return np.array(attitude), np.array(place)


def clock_offset_s(flight: Flight, attitude: np.ndarray) -> float:
    """Find how much later than the log the gateway's clock started, by the attitudes."""
    offsets = np.arange(-0.1, MAX_START_S, 0.01)
    return float(
        min(offsets, key=lambda s: np.nanmean(attitude_errors_deg(flight, attitude, s) ** 2))
    )


def attitude_errors_deg(flight: Flight, attitude: np.ndarray, offset_s: float) -> np.ndarray:
    """Roll, pitch and yaw of the sent attitude less the reference's, where it counts."""
    time_s = flight.log.imu_time_us / 1e6
    known = np.isfinite(flight.q_nb).all(axis=1) & flight.counts
    reference = Slerp(time_s[known], Rotation.from_quat(flight.q_nb[known], scalar_first=True))
    at = attitude[:, 0] - offset_s
    inside = (at >= time_s[known][0]) & (at <= time_s[known][-1])
    sent = Rotation.from_quat(attitude[inside, 1:], scalar_first=True)
    difference = sent.as_euler("ZYX") - reference(at[inside]).as_euler("ZYX")
    return np.degrees(wrap_pi(difference[:, ::-1]))


def position_errors_m(flight: Flight, place: np.ndarray, offset_s: float) -> np.ndarray:
    """Horizontal distance of the sent position from the reference, where it counts."""
    time_s = flight.log.imu_time_us / 1e6
    known = np.isfinite(flight.pos_ne_m).all(axis=1) & flight.counts
    at = place[:, 0] - offset_s
    inside = (at >= time_s[known][0]) & (at <= time_s[known][-1])
    truth = [np.interp(at[inside], time_s[known], flight.pos_ne_m[known, k]) for k in range(2)]
    return np.hypot(*(north_east_m(flight, *place[inside, 1:].T).T - truth))


def fix_errors_m(flight: Flight, place: np.ndarray, offset_s: float) -> np.ndarray:
    """Horizontal distance of the sent position from each GPS fix, at the time it was valid."""
    valid_s = flight.log.gps_time_us / 1e6 - flight.reference.gps_latency_s
    at = place[:, 0] - offset_s
    inside = (valid_s >= at[0]) & (valid_s <= at[-1])
    ours = north_east_m(flight, *place[:, 1:].T)
    track_ne = np.array([np.interp(valid_s[inside], at, ours[:, k]) for k in range(2)])
    return np.hypot(*(track_ne - north_east_m(flight, *flight.log.gps[inside, 1:3].T).T))


def main() -> None:
    """Fly the log, score it, print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("flight", type=Path, help="a log with reference columns")
    parser.add_argument("--real-time", action="store_true", help="through pty and UDP")
    options = parser.parse_args()
    flight = read_flight(options.flight)
    way = through_sockets if options.real_time else through_pipeline
    attitude, place = collect(way(options.flight))
    offset_s = clock_offset_s(flight, attitude)
    table = Table(title=f"{flight.name}: what came out as MAVLink", box=box.SIMPLE_HEAD)
    for column in ("", "RMSE", "max"):
        table.add_column(column, justify="left" if not column else "right")
    rows = dict(
        zip(
            ("roll deg", "pitch deg", "yaw deg"),
            attitude_errors_deg(flight, attitude, offset_s).T,
            strict=True,
        )
    )
    rows["position against reference m"] = position_errors_m(flight, place, offset_s)
    rows["track against GPS fixes m"] = fix_errors_m(flight, place, offset_s)
    for name, errors in rows.items():
        table.add_row(name, f"{np.sqrt(np.mean(errors**2)):.2f}", f"{np.abs(errors).max():.1f}")
    Console().print(table)
    print(f"{len(attitude)} attitudes, {len(place)} positions, clock offset {offset_s:.2f} s")


if __name__ == "__main__":
    main()
