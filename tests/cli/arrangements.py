"""Arrangements of files for the transcripts, by name; see `test_transcripts.py`."""

import gzip
import os
import struct
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import wraps
from pathlib import Path

import msgspec
import numpy as np
import pytest
from intelhex import IntelHex
from pymavlink.dialects.v20 import all as mavlink

from gateway.aircraft import AircraftSettings
from gateway.flashing import boards
from gateway.live.serial_port import Port
from gateway.recordings.recorded_table import header_for
from gateway.recordings.rows import TableRow
from gateway.recordings.table import TableHeader, encode_head
from gateway.records import GpsFix, ImuCalibrated, ImuFlags, ImuRaw, NodeId
from tests.analysis.test_flight import rows
from tests.batch.flights import line_of
from tests.cli import machines
from tests.cli.recorded import test_diff
from tests.cli.recorded import test_extract as extracts
from tests.estimation.samples import fix
from tests.flashing.test_settings_block import BLOCK, NRF24_BLOCK, image_with, with_crc
from tests.kit.mavlink import Sender
from tests.kit.recordings import (
    START_US,
    make_frames,
    make_records,
    records_of,
    write_table,
    write_tlog,
)
from tests.kit.records import raw_at, state_at
from tests.recordings import test_autopilot_record
from tests.recordings.flights import flown_table, read
from tests.recordings.formats import flown

NAMES = "time_s,ax,ay,az,gx,gy,gz,baro_alt_m,gps_time_s,gps_lat,gps_lon,gps_alt_m"
NUMBERS = ("0", "0", "-9.8", "0", "0", "0", "100", "0.1", "47", "8", "500")
RECORDS = make_records(500)
AC31 = """\
FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns
FMT, 129, 23, PARM, Nf, Name,Value
FMT, 130, 45, GPS, BIHBcLLeeEefI, Status,TimeMS,Week,NSats,HDop,Lat,Lng,RelAlt,Alt,Spd,GCrs,VZ,T
FMT, 131, 31, IMU, Iffffff, TimeMS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ
PARM, SYSID_THISMAV, 3.0"""
RECENT = """\
FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns
FMT, 129, 31, PARM, QNff, TimeUS,Name,Value,Default
FMT, 130, 51, GPS, QBBIHBcLLeffffB, TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U
FMT, 131, 48, IMU, QBffffffIIfBBHH, TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz
PARM, 10000000, MAV_SYSID, 7, 1"""
EMPTY = {
    "formats": b"\x83\x30",
    "imu": b"\x80\x83\x27IMU\0fffffffff" + bytes(7) + b"AccX,AccY,AccZ,GyroX,GyroY",
    "sdlog2": b"\x80\x83\x27IMU\0fffffffff"
    + bytes(7)
    + b"AccX,AccY,AccZ,GyroX,GyroY,GyroZ,MagX,MagY,MagZ",
    "rows": b"\x80\x83\x1bIMU\0Qffffff" + bytes(9) + b"TimeUS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ",
}
"""Formats of DataFlash logs without a sample."""


Make = Callable[..., None]


def made_once(make: Make) -> Make:
    """Keep the files that a function makes, and write them again for later cases."""
    kept: dict[tuple[str, ...], dict[Path, bytes]] = {}

    @wraps(make)
    def write(folder: Path, *arguments: str) -> None:
        if arguments not in kept:
            make(folder, *arguments)
            # The newest is the last recording.
            files = sorted(filter(Path.is_file, folder.rglob("*")), key=os.path.getmtime)
            kept[arguments] = {path.relative_to(folder): path.read_bytes() for path in files}
        for name, data in kept[arguments].items():
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_bytes(data)

    return write


def log(folder: Path, name: str = "log.csv", **odd: str) -> Path:
    """Write a tracker's log of a second, every tenth row of which has an odd cell."""
    lines = [NAMES]
    for number in range(100):
        cells = dict(zip(NAMES.split(","), [f"{number / 100}", *NUMBERS], strict=True))
        lines.append(",".join((cells | odd if number % 10 == 5 else cells).values()))
    (folder / name).write_text("\n".join(lines) + "\n")
    return folder / name


def odd_log(folder: Path, cell: str) -> None:
    """Write a log with `COLUMN=VALUE` in every tenth row; `1*99` is 99 ones."""
    column, _, value = cell.partition("=")
    digit, star, count = value.partition("*")
    log(folder, **{column: digit * int(count) if star else value})


def table(folder: Path, head: str = "unix_us_at_zero=0", name: str = "table.csv") -> Path:
    """Write a table of one state."""
    key, _, value = head.partition("=")
    header = msgspec.structs.replace(header_for(AircraftSettings(), 1), **{key: int(value)})
    return write_table(folder / name, header, [TableRow(1000, state=state_at(1000))])


@made_once
def flight(folder: Path) -> None:
    """Write a tlog of 10 s, and a table of 20 s with all sensors."""
    write_tlog(folder / "flight.tlog", RECORDS)
    (folder / "flight.csv").write_bytes(flown_table(20))


def mixed(folder: Path) -> None:
    """Write a tlog of systems 1, 2 and 7."""
    found = [*make_records(90), *make_records(90, 2), *make_records(30, 7)]
    write_tlog(folder / "a.tlog", sorted(found, key=lambda record: record.time_us))


@made_once
def autopilots(folder: Path) -> None:
    """Write `flight.bin`, with plans, and `flight.ulg`, each with defaults of its parameters."""
    test_autopilot_record.write_with_plans(folder / "flight.bin")
    default = flown.ulog_message(b"Q", b"\x01" + flown.ulog_parameter("MAV_SYS_ID", 1))
    flown.write(folder / "flight.ulg", test_autopilot_record.px4_log() + default)


@made_once
def half_minute(folder: Path, speed: str = "") -> None:
    """Write half a minute of flight, or of a receiver at rest."""
    made = rows(raw=False)
    if speed == "rest":
        slow = {"vel_n_mps": (0.2, 0.1, 0.0)}
        made = [replace(r, gps=r.gps and msgspec.structs.replace(r.gps, **slow)) for r in made]
    write_table(folder / "flight.csv", TableHeader(), made)


def short(folder: Path) -> None:
    """Write a table of one sample."""
    rest = ((0.0, 0.0, -9.81), (0.0, 0.0, 0.0), None, 20.0, ImuFlags(0))
    row = TableRow(10_000, imu=ImuCalibrated(10_000, NodeId(1, 0), *rest))
    write_table(folder / "flight.csv", header_for(AircraftSettings(), 1), [row])


def recordings(folder: Path) -> None:
    """Write recordings `alps` (tlog and tables of two parts) and `lake` (a tlog of system 7)."""
    recorded(below := folder / "recordings")
    (folder / "gateway.toml").write_text(f'[recording]\nfolder = "{below}"\n')


@made_once
def recorded(below: Path) -> None:
    below.mkdir(exist_ok=True)
    write_tlog(below / "alps_01.tlog", make_records(4000))
    header, flown = read(flown_table(12))
    header = msgspec.structs.replace(header, unix_us_at_zero=START_US)
    write_table(below / "alps_01_v1.csv", header, flown[: len(flown) // 2])
    write_table(below / "alps_02_v1.csv", header, flown[len(flown) // 2 :])
    write_tlog(below / "lake_01.tlog", make_records(30, system_id=7))


def packed(path: Path, head: bytes, piece: bytes, mb: int) -> Path:
    """Pack a head and many copies of a piece of a megabyte."""
    with gzip.open(path, "wb") as file:
        file.write(head)
        for _ in range(mb):
            file.write(piece)
    return path


@made_once
def zipped(folder: Path, fault: str) -> None:
    """Write `log.csv.gz`: cut, damaged, a bomb, or no gzip file (and `log.csv`, which is one)."""
    path = folder / "log.csv.gz"
    data = log(folder, path.name).read_bytes()
    if fault == "none":
        (folder / "log.csv").write_bytes(gzip.compress(data))
    elif fault == "bomb":
        packed(path, NAMES.encode() + b"\n", (b"#" * 1023 + b"\n") * 1024, 34)
    else:
        whole = gzip.compress(data)
        path.write_bytes(whole[:-100] if fault == "cut" else whole[:-8] + bytes(8))


def endless(folder: Path, kind: str) -> None:
    path = folder / "log.csv.gz"
    os.mkfifo(path) if kind == "pipe" else path.symlink_to("/dev/zero")


def introduced(folder: Path) -> None:
    """Write a tlog with a heartbeat and a parameter."""
    sent = (
        mavlink.MAVLink_heartbeat_message(2, 3, 128, 5, 4, 3),
        mavlink.MAVLink_param_value_message(b"WPNAV_SPEED", 512.5, 9, 3, 0),
    )
    write_tlog(folder / "a.tlog", records_of(map(Sender().pack, sent), 100_000))


def compared(folder: Path) -> None:
    """Write `a.tlog` and `b.tlog` with other parameters, missions and texts."""
    test_diff.write_both(folder)


@made_once
def mission(folder: Path) -> None:
    """Write `flight.tlog` with parameters, mission, fence, texts and images."""
    extracts.written(folder, extracts.flight())


def future(folder: Path) -> None:
    records = (struct.pack(">Q", 10**18) + frame for frame in make_frames(20))
    (folder / "future.tlog").write_bytes(b"".join(records))


def old_log() -> list[str]:
    lines = [AC31]
    for ms in range(60_000, 72_000, 20):
        lines.append(f"IMU, {ms}, 0.001, 0.002, 0.003, 0.01, -0.02, -9.8")
        if ms % 200 == 0:
            week_ms = 345_540_000 + ms
            lines.append(f"GPS, 3, {week_ms}, 1770, 10, 1.2, 47.1, 8.5, 0.1, 500, 5, 90, 0, {ms}")
    return lines


def recent_log(
    begin_us: int = 10_000_000, gps: int = 0, imu: int = 0, week: int = 2300
) -> list[str]:
    lines = []
    for ms in range(0, 12_000, 20):
        head, axes = f"{begin_us + 1000 * ms}", "0.001, 0.002, 0.003, 0.01, -0.02, -9.8"
        lines.append(f"IMU, {head}, {imu}, {axes}, 0, 0, 25, 1, 1, 400, 400")
        if ms % 200 == 0:
            location = "12, 0.8, 47.1, 8.5, 500, 5, 90, 0, 0, 1"
            lines.append(f"GPS, {head}, {gps}, 3, {345_600_000 + ms}, {week}, {location}")
    return lines


@made_once
def dataflash(folder: Path, kind: str) -> None:
    """Write a DataFlash log of text: of old or recent firmware, or with a fault."""
    first = recent_log()
    lines = {
        "old": lambda: old_log(),
        "titled": lambda: ["", "ArduCopter V3.1.2 (abc)", "Free RAM: 990", "", *old_log()],
        "second": lambda: [RECENT, *recent_log(gps=1, imu=2)],
        "both": lambda: [RECENT, *first, *recent_log(gps=1)[1::11]],
        "rolled": lambda: [RECENT, *recent_log(week=2300 - 1024)],
        "boots": lambda: [RECENT, *first, *first],
        "late": lambda: [RECENT, *first, *recent_log(10_040_000)],
        "short": lambda: [RECENT, *first, *first[:20]],
    }[kind]()
    (folder / "a.log").write_text("\n".join([*lines, ""]))


def empty_dataflash(folder: Path, kind: str) -> None:
    data = b"\xa3\x95" + EMPTY[kind].ljust(87, b"\0")
    rows = (
        20 * (b"\xa3\x95\x83" + struct.pack("<9f", *range(9))) if kind == "sdlog2" else bytes(600)
    )
    (folder / "a.bin").write_bytes(data + rows)


def samples(delimiter: str, *, comma: bool = False, step: int = 1) -> str:
    """Return a log with samples at 100 Hz, or with some of them."""
    lines = ["time_s ax ay az gx gy gz"]
    lines += [f"{n / 100:.2f} 0.01 -0.02 -9.80 0.001 0.002 0.003" for n in range(0, 500, step)]
    text = "\n".join([*lines, ""])
    return (text.replace(".", ",") if comma else text).replace(" ", delimiter)


def dialect(folder: Path, kind: str) -> None:
    """Write `log.csv` with another delimiter, decimal mark or encoding, or 2 Hz."""
    (folder / "log.csv").write_bytes(
        {
            "commas": samples(",").encode(),
            "blanks": samples(", ").encode(),
            "semicolons": samples(";").encode(),
            "semicolons, decimal": samples(";", comma=True).encode(),
            "tabs": samples("\t").encode(),
            "tabs, decimal": samples("\t", comma=True).encode(),
            "utf-16": samples(",").replace("\n", "\r\n").encode("utf-16"),
            "utf-16-le": samples(",").encode("utf-16-le"),
            "utf-16-be": samples(",").encode("utf-16-be"),
            "title": b"MPU6050 connection successful\nInitializing...\n" + samples(",").encode(),
            "lacking": samples(";").replace("gz", "gyro_z").encode("utf-16"),
            "slow": samples(",", step=50).encode(),
        }[kind]
    )


def images(folder: Path, *, monkeypatch: pytest.MonkeyPatch) -> None:
    """Write images of one program, on a machine without serial ports."""
    for name, block in (("imu", NRF24_BLOCK), ("imu_sx1276", BLOCK)):
        image = IntelHex()
        image.puts(0, image_with(with_crc(block)))
        for mhz in (16, 8):
            image.write_hex_file(str(folder / f"{name}_{mhz}mhz.hex"))
    monkeypatch.setattr(boards, "IMAGES", folder)
    for module in ("flash", "doctor"):
        monkeypatch.setattr(f"gateway.cli.live.{module}.list_serial_ports", list[Port])


def turning(folder: Path) -> None:
    """Write a flight of vehicle 3 in smooth air: a rest, and a long turn that is as even."""
    rng = np.random.default_rng(2)
    records: list[ImuRaw | GpsFix] = []
    for time_us in range(0, 80_000_000, 20_000):
        turns = time_us >= 20_000_000
        if time_us % 200_000 == 0:
            records.append(fix(time_us, vel=(15.0 if turns else 0.0, 0.0, 0.0)))
        x, y, z = map(int, (np.array([5, -8, 330 if turns else 11]) + rng.normal(0, 1, 3)).round())
        raw = {"accel_raw": (0, 0, 4096), "gyro_raw": (x, y, z), "flags": ImuFlags(0)}
        records.append(raw_at(time_us, node=NodeId(3, 0), **raw))
    head = encode_head(TableHeader(vehicle_id=3))
    (folder / "flight_01_v3.csv").write_text(head + "".join(map(line_of, records)))
    (folder / "g.toml").write_text('aircraft_folder = "."\n[recording]\nfolder = "."\n')


MAKE: dict[str, Callable[..., object]] = {
    made.__name__: made
    for made in (
        log, odd_log, table, flight, mixed, short, autopilots, half_minute, recordings, zipped,
        endless, introduced, future, compared, mission, images, dataflash, empty_dataflash,
        dialect, turning,
        machines.link,
    )
}  # fmt: skip


def change(path: Path, how: str) -> None:
    """Do `OLD => NEW`, `cut N`, `insert AT N`, `blank LINE`, `bom`, `encode X` or `latin X`."""
    data = path.read_bytes()
    word, *numbers = how.split()
    match word:
        case "cut":
            data = data[: -int(numbers[0])]
        case "insert":
            at, count = map(int, numbers)
            data = data[:at] + b"\xaa" * count + data[at:]
        case "blank":
            lines = data.split(b"\n")
            lines[int(numbers[0]) - 1] = b"\0" * 50
            data = b"\n".join(lines)
        case "bom":
            data = b"\xef\xbb\xbf" + data
        case "encode":
            data = data.decode().encode(numbers[0])
        case "latin":
            data = how.removeprefix("latin ").encode("latin-1") + b"\n" + data
        case _:
            old, new = how.split(" => ")
            assert old.encode() in data
            data = data.replace(old.encode(), new.replace("\\n", "\n").encode(), 1)
    path.write_bytes(data)


SERVE = {
    serve.__name__: serve
    for serve in (machines.gateway, machines.receiver, machines.line, machines.machine)
}


def arrange(text: str, folder: Path, monkeypatch: pytest.MonkeyPatch, opened: ExitStack) -> None:
    """Make an arrangement, which may hold until the end of the case.

    Arguments with ` @ FILE` at their end change it; `FILE: TEXT` writes one; the others are the
    arguments of the function.
    """
    name, *arguments = text.split("; ")
    own, after = list[str](), list[str]()
    for one in arguments:
        (after if " @ " in one or re_file(one) else own).append(one)
    make = MAKE.get(name) or SERVE.get(name)
    if make is not None:
        patched = {"monkeypatch": monkeypatch} if "monkeypatch" in make.__annotations__ else {}
        made = make(folder, *own, **patched)
        if name in SERVE:
            opened.enter_context(made)
    for one in after:
        if " @ " in one:
            how, _, file = one.rpartition(" @ ")
            change(folder / file, how)
        else:
            file, _, content = one.partition(": ")
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            (folder / file).write_text(content.replace("\\n", "\n").replace("HERE", str(folder)))


def re_file(text: str) -> bool:
    """Return whether an argument is a file to write."""
    head, colon, _ = text.partition(": ")
    return bool(colon) and " " not in head
