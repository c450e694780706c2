"""A recording made by the running program goes through every output, each read by others."""

import json
import signal
import socket
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader
from pymavlink import mavutil
from pymavlink.dialects.v20 import all as mavlink

from gateway.analysis.reporting.raw_sensors import timing
from gateway.clock import GatewayClock
from gateway.live.control_socket import request
from gateway.panel.playback import FUSED_AGAIN, RECORDED, Playback
from gateway.panel.state.fleet import FleetState
from gateway.panel.uplink import ControlClient, Uplink
from gateway.recordings.tlog import TlogScanner
from tests.end_to_end.processes import Gateway
from tests.end_to_end.station import Station
from tests.kit.cli import invoke
from tests.kit.ground_station import item, upload
from tests.kit.process import wait_for

pytestmark = [pytest.mark.io, pytest.mark.slow]

CONFIG = """
[hub]
endpoints = ["tcp-listen:127.0.0.1:{listen}"]

[simulator]
gps_first_fix_s = 0.5
vehicles = 2

[recording]
folder = FOLDER
"""
LONG = "Companion: der Platz auf der Karte genügt nicht mehr für die nächsten Bilder"
PRIVATE_ID = 44_000
"""Of a message that no dialect knows."""
RECORDED_S = 5.0


def private_frame(link: mavlink.MAVLink) -> bytes:
    frame = bytearray(mavlink.MAVLink_heartbeat_message(0, 0, 0, 0, 0, 0).pack(link))
    frame[7:10] = PRIVATE_ID.to_bytes(3, "little")
    return bytes(frame)


def located(messages: list[Any]) -> bool:
    positions = [m for m in messages if m.get_type() == "GLOBAL_POSITION_INT"]
    return {m.get_srcSystem() for m in positions if m.lat} >= {1, 2}


def station_of(port: int, version: int) -> Station | None:
    """Connect a station, unless the gateway does not listen yet."""
    try:
        return Station.connect(socket.SOCK_STREAM, port, version)
    except OSError:
        return None


def record(gateway: Gateway) -> None:
    """Record a station that uploads a mission, one of MAVLink 1, and a companion.

    It begins at known positions, so that every output has a track of both aircraft.
    """
    port = gateway.listen_port
    stations = [wait_for(lambda v=version: station_of(port, v)) for version in (2, 1)]
    stations[1].mav.srcSystem = 254
    companion = mavlink.MAVLink(None, 1, mavlink.MAV_COMP_ID_ONBOARD_COMPUTER)
    with socket.create_connection(("127.0.0.1", port)) as sock:
        beat = mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)
        turned = mavlink.MAVLink_attitude_message(0, 1.0, 1.0, 1.0, 0, 0, 0)
        data = LONG.encode()
        texts = [
            mavlink.MAVLink_statustext_message(4, data[at : at + 50], 9, chunk)
            for chunk, at in enumerate(range(0, len(data), 50))
        ]
        stations[0].until_heard()
        wait_for(lambda: located(stations[0].wait(0.2)))
        request(gateway.socket, "record.start")
        for message in (beat, turned, *texts, turned):
            sock.sendall(message.pack(companion))
            companion.seq += 1
        sock.sendall(private_frame(companion))
        assert upload(stations[0], [item(n) for n in range(3)]) == mavlink.MAV_MISSION_ACCEPTED
        stations[1].wait(RECORDED_S)
    for station in stations:
        station.close()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("own")
    config = CONFIG.replace("FOLDER", json.dumps(str(path / "recordings")))
    gateway = Gateway(path, "demo", config=config)
    try:
        record(gateway)
    finally:
        gateway.end(signal.SIGTERM)
    wait_for(lambda: list((path / "recordings").glob("*_v2.csv")) or None)
    return path / "recordings"


@pytest.fixture(scope="module")
def tlog(folder: Path) -> Path:
    (found,) = folder.glob("*_01.tlog")
    return found


def converted(files: list[Path], target: Path, *options: str) -> Path:
    invoke("convert", *files, "-o", target, "--force", *options, code=0)
    return target


def test_recording_holds_what_the_outputs_must_bear(tlog: Path) -> None:
    found = set()
    with closing(mavutil.mavlink_connection(str(tlog), dialect="all")) as log:
        while (message := log.recv_msg()) is not None:
            found.add((message.get_srcSystem(), message.get_srcComponent(), message.get_type()))
    assert {(1, 1, "GLOBAL_POSITION_INT"), (2, 1, "GLOBAL_POSITION_INT")} <= found
    assert {(255, 190, "MISSION_COUNT"), (1, 191, "STATUSTEXT")} <= found
    assert {"UNKNOWN_300", f"UNKNOWN_{PRIVATE_ID}"} <= {kind for *_, kind in found}
    assert any(system == 254 for system, _, _ in found)


@pytest.mark.parametrize("ending", ["kml", "gpx"])
def test_maps_are_read_by_an_xml_parser(tlog: Path, tmp_path: Path, ending: str) -> None:
    root = ET.fromstring(converted([tlog], tmp_path / f"f.{ending}").read_bytes())
    elements = list(root.iter())
    names = {element.text for element in elements if element.tag.endswith("}name")}
    assert {"system 1", "system 2", LONG} <= names
    assert not any("nan" in (e.text or "").lower().split() for e in elements)
    leaves = [e for e in elements if not len(e) and not e.attrib]
    assert all((e.text or "").strip() for e in leaves)


def test_mcap_is_read_by_its_library(tlog: Path, tmp_path: Path) -> None:
    path, topics, logs = converted([tlog], tmp_path / "f.mcap"), set(), []
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            topics.add(channel.topic)
            if channel.topic == "/log":
                logs.append(json.loads(message.data)["message"])
    assert {"/mavlink/1/1/PROTOCOL_VERSION", "/vehicle_1/pose", "/vehicle_2/location"} <= topics
    assert LONG in logs
    assert "/vehicle_255/state" not in topics


@pytest.mark.parametrize("name", ["PROTOCOL_VERSION", "STATUSTEXT", "HIGHRES_IMU", "PARAM_VALUE"])
def test_messages_are_read_by_arrow(tlog: Path, tmp_path: Path, name: str) -> None:
    path = converted([tlog], tmp_path / "f.parquet", "--message", name)
    rows = pq.read_table(path).to_pylist()
    assert rows
    assert {row["system_id"] for row in rows} >= {1}


def test_every_record_is_read_by_mavlogdump(tlog: Path) -> None:
    batch = TlogScanner(strict=True).feed(tlog.read_bytes(), final=True)
    assert batch.damage == ()
    command = [sys.executable, str(Path(sys.executable).parent / "mavlogdump.py"), str(tlog)]
    dumped = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert len([line for line in dumped.splitlines() if " {" in line]) == len(batch)
    assert "BAD_DATA" not in dumped


def test_summary_names_vehicles_and_gives_stations_no_distance(tlog: Path) -> None:
    found = json.loads(invoke("info", "--json", tlog, code=0).output)
    vehicles = {vehicle["system_id"]: vehicle for vehicle in found["vehicles"]}
    assert vehicles[1]["positions"] == vehicles[2]["positions"] == "GLOBAL_POSITION_INT"
    assert vehicles[1]["mav_type"] == mavlink.MAV_TYPE_FIXED_WING
    assert vehicles[255]["facts"] is vehicles[255]["positions"] is None
    assert " km" not in invoke("info", tlog, code=0).output.split("system 255")[1]


def test_catalogue_is_read_by_sqlite_and_agrees_with_the_summary(folder: Path, tlog: Path) -> None:
    invoke("info", folder, code=0)
    with sqlite3.connect(folder / "catalogue.sqlite") as db:
        columns = "kind, vehicle, error, distance, airborne, highest, height_above, fastest"
        rows = db.execute(f"SELECT {columns} FROM flights").fetchall()
    assert sorted((kind, vehicle) for kind, vehicle, *_ in rows) == [
        ("table", 1), ("table", 2), ("tlog", 1), ("tlog", 2),
    ]  # fmt: skip
    assert {error for _, _, error, *_ in rows} == {None}
    info = json.loads(invoke("info", "--json", tlog, code=0).output)
    by_info = {one["system_id"]: one["facts"] for one in info["vehicles"]}
    for kind, vehicle, _, *facts in rows:
        if kind == "tlog":
            assert facts == [
                by_info[vehicle][name]
                for name in (
                    *("distance_m", "airborne_s", "highest_m", "height_above", "fastest_mps"),
                )
            ]


def test_tables_are_fused_again_and_recovered(folder: Path, tlog: Path, tmp_path: Path) -> None:
    (table,) = folder.glob("*_01_v1.csv")
    invoke("fuse", table, "-o", tmp_path / "fused.csv", code=0)
    assert (tmp_path / "fused.csv").read_bytes() == table.read_bytes()
    for file in (tlog, table):
        kept = tmp_path / f"kept{file.suffix}"
        assert "nothing was damaged" in invoke("recover", file, "-o", kept, code=0).output
        assert kept.read_bytes() == file.read_bytes()


async def test_recording_is_played_in_the_panel(folder: Path, tlog: Path) -> None:
    fleet = FleetState()
    uplink = Uplink(None, fleet, ControlClient(None), GatewayClock())
    playback = Playback(uplink, fleet, "page")
    try:
        uplink.start()
        await playback.open(folder, tlog.name.removesuffix("_01.tlog"), fused_again=True)
        origins = sorted((one.recorded_id, one.origin) for one in playback.aircraft.values())
        assert origins == [(1, FUSED_AGAIN), (1, RECORDED), (2, FUSED_AGAIN), (2, RECORDED)]
        await playback.order("seek", to="2")
        assert playback.status is not None
        assert playback.status["duration_s"] > RECORDED_S
    finally:
        player = playback._child
        playback.close()
        uplink.close()
        if player is not None:
            await player.communicate()


def test_page_and_reports_are_made(
    folder: Path, tlog: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One section stands for all of them, which take a minute to draw."""
    monkeypatch.setattr("gateway.analysis.reporting.compose.SECTIONS", (timing,))
    invoke("report", tlog, "-o", tmp_path / "f.html", "--quick", code=0)
    assert "<html" in (tmp_path / "f.html").read_text()[:500]
    invoke("report", "--quick", folder, "-o", tmp_path / "out", "--jobs", 1, code=0)
    page = (tmp_path / "out" / "index.html").read_text()
    assert all(table.name in page for table in folder.glob("*_01_v?.csv"))


def test_recording_is_played_as_fast_as_possible(tlog: Path, tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        sock.settimeout(20.0)
        target = f"udp:127.0.0.1:{sock.getsockname()[1]}"
        invoke("play", tlog, "--speed", "inf", "-e", target, code=0)
        parser = mavlink.MAVLink(None)
        parser.robust_parsing = True
        kinds = {m.get_type() for m in parser.parse_buffer(sock.recv(65_536)) or []}
    assert kinds
