"""Measure the commands for recordings on a long flight: processor time, elapsed time and memory.

    python -m tools.bench_flightlog [--messages 1000000]

The baseline is `mavlogdump` of pymavlink on the same file in the same run: to CSV it prints one of
the messages, and it filters one tlog into another. No network is needed.
"""

import math
import os
import tempfile
from pathlib import Path

from pymavlink.dialects.v20 import common as mavlink

from gateway.recordings.tlog import encode_record
from tools.harness import MAVGATE, PYTHON, Figures, arguments, run, show, write_json

START_US = 1_781_187_930_000_000
HOLE = 2 << 30
"""Bytes of zeros in a sparse file."""


def flight_frames(second: int, imu_hz: int) -> list[bytes]:
    """Pack the frames that the gateway sends in one second at its default rates, in 50 steps.

    `imu_hz` is 10 or 50.
    """
    mav = mavlink.MAVLink(None, 1, 1)
    frames = []
    for step in range(50):
        ms, x = 1000 * second + 20 * step, math.sin(second + step / 50)
        q = (1.0, 0.1 * x, 0.2, 0.3)
        messages = [
            mavlink.MAVLink_attitude_quaternion_message(ms, *q, 0.4, 0.5, x),
            mavlink.MAVLink_attitude_message(ms, 0.1, x, 0.3, 0.4, 0.5, 0.6),
        ]
        if step % 5 == 0 or imu_hz == 50:
            accel, gyro, mag = (0.1, x, -9.81), (0.01 * x, 0.02, 0.03), (0.2, 0.01, 0.4)
            air = (950.0 + x, 0.0, 500.0, 21.5)
            messages.append(
                mavlink.MAVLink_highres_imu_message(1000 * ms, *accel, *gyro, *mag, *air, 511)
            )
        if step % 5 == 0:
            position = (471_000_000 + ms, 85_000_000 - ms, 500_000, 60_000)
            messages += [
                mavlink.MAVLink_global_position_int_message(ms, *position, 100, 50, 10, 9000),
                mavlink.MAVLink_vfr_hud_message(20.0, 20.0, 90, 50, 500.0, x),
                mavlink.MAVLink_scaled_pressure_message(ms, 950.0 + x, 0.0, 2150),
            ]
        if step % 10 == 0:
            fix = (3, 471_000_000 + ms, 85_000_000 - ms, 500_000, 80, 120, 2000, 9000, 12)
            messages.append(mavlink.MAVLink_gps_raw_int_message(1000 * ms, *fix))
        if step == 0:
            messages.append(mavlink.MAVLink_heartbeat_message(1, 0, 0, 0, 4, 3))
        frames += [bytes(message.pack(mav)) for message in messages]
    return frames


def write_flight(path: Path, count: int, imu_hz: int = 10) -> None:
    """Write the tlog of a flight, of at least `count` messages."""
    written, second = 0, 0
    with path.open("wb") as file:
        while written < count:
            frames = flight_frames(second, imu_hz)
            begin_us, step_us = START_US + second * 1_000_000, 1_000_000 // len(frames)
            file.writelines(encode_record(begin_us + i * step_us, f) for i, f in enumerate(frames))
            written, second = written + len(frames), second + 1


def commands(folder: Path, count: int) -> dict[str, tuple[str, ...]]:
    """Write the flights; return the measured commands, baselines included, by name."""
    flight, sampled, sparse = (folder / f"{name}.tlog" for name in ("flight", "sampled", "sparse"))
    write_flight(flight, count)
    # An autopilot's log on which all estimators run.
    write_flight(sampled, count, imu_hz=50)
    data = flight.read_bytes()[: 1 << 20]
    with sparse.open("wb") as file:
        file.write(data)
        file.seek(HOLE, os.SEEK_CUR)
        file.write(data)
    dump = (PYTHON, str(Path(PYTHON).with_name("mavlogdump.py")))

    def made(command: str, ending: str, path: Path, *options: str) -> tuple[str, ...]:
        out = str(folder / f"out{ending}")
        return (*MAVGATE, command, str(path), *options, "--force", "-o", out)

    filtered = ("--without", "ATTITUDE")
    return {
        "info": (*MAVGATE, "info", str(flight)),
        "to CSV": made("convert", ".csv", flight),
        "to CSV by mavlogdump": (*dump, "--format", "csv", "--types", "HIGHRES_IMU", str(flight)),
        "to MCAP, 50 IMU samples/s": made("convert", ".mcap", sampled),
        "anonymised": made("convert", ".tlog", sampled, "--anonymise"),
        "as a page": made("report", ".html", sampled),
        "fused": made("fuse", ".csv", sampled),
        "filtered": made("convert", ".tlog", flight, *filtered),
        "filtered by mavlogdump": (
            *dump, "-q", "-o", str(folder / "out.tlog"), "--nottypes", "ATTITUDE", str(flight),
        ),
        "cut": made("convert", ".tlog", flight, "--from", "10"),
        "renumbered": made("convert", ".tlog", flight, "--as", "1:2"),
        "merged with itself": made("convert", ".tlog", flight, str(flight), "--merge"),
        "filtered, 2 GB sparse": made("convert", ".tlog", sparse, *filtered),
    }  # fmt: skip


def main() -> None:
    """Measure, and print the figures."""
    parser = arguments(__doc__)
    parser.add_argument("--messages", type=int, default=1_000_000)
    parser.add_argument("--only", default="", metavar="WORD", help="commands with this word")
    options = parser.parse_args()
    found: dict[str, Figures] = {}
    with tempfile.TemporaryDirectory(prefix="mavgate-bench-") as name:
        for title, command in commands(Path(name), options.messages).items():
            if options.only in title:
                found[title] = run(*command)
    show(
        f"commands on a flight of {options.messages:,} messages",
        ("command", "s", "CPU s", "MB"),
        [(title, *figures.values()) for title, figures in found.items()],
    )
    write_json(options, found)


if __name__ == "__main__":
    main()
