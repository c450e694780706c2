"""The live view: its figures and texts, and dashes for unknown values."""

import logging
import math
from dataclasses import replace

import msgspec
import pytest
from rich.console import Console

from gateway.geometry.quaternion import from_euler
from gateway.hub.stats import HubCounters, ListenerStats
from gateway.live.console import LiveView
from gateway.records import (
    NAN,
    UNKNOWN_VEC3,
    LinkReport,
    NavFlags,
    NodeId,
    NodeLink,
    NodeStatus,
    PipeCounters,
    ReceiverStatus,
)
from gateway.status import AircraftStatus, RecorderStatus, RelativeLocation, Snapshot, summary_line
from gateway.vehicle_row import VehicleRow
from tests.client_stats import TABLET
from tests.kit.records import FIX, NOTHING

NODE = NodeLink(NodeId(1, 0), 0, 990, 10, 3, 0, 1, 99.6, 9_900_000, -42.0)
RECEIVER = ReceiverStatus(9_000_000, 9_000_000, 76, 4, 0, 1, (PipeCounters(0, 0, 0),) * 6)
REPORT = LinkReport(
    10_000_000, True, "/dev/ttyUSB0", 40_000, 1000, 2, (("crc", 7),), (NODE,), RECEIVER
)
FLYING = msgspec.structs.replace(
    NOTHING,
    time_us=9_990_000,
    q_nb=from_euler(math.radians(-12.0), math.radians(3.0), math.radians(-90.0)),
    lat_deg=-7.765612,
    lon_deg=110.372834,
    alt_amsl_m=171.5,
    vel_n_mps=(3.0, -4.0, -1.5),
    flags=NavFlags.ATTITUDE_VALID | NavFlags.POSITION_VALID | NavFlags.GPS_REJECTED,
)
LOST = msgspec.structs.replace(
    FLYING, lat_deg=NAN, lon_deg=NAN, alt_amsl_m=NAN, vel_n_mps=UNKNOWN_VEC3
)
CLIENT = replace(
    TABLET,
    name="",
    endpoint="udp:127.0.0.1:14550",
    remote="127.0.0.1:14550",
    systems=((255, 190),),
    sent=1200,
    dropped=3,
    bytes_sent=50_000,
    received=9,
    bytes_received=200,
    heard_us=9_500_000,
)
SNAPSHOT = Snapshot(
    10_000_000, REPORT, ((1, FLYING),), (CLIENT,), ((0, 10), (31, 500)), HubCounters()
)


def text_of(
    *snapshots: Snapshot, width: int = 100, coloured: bool = False, view: LiveView | None = None
) -> str:
    view = view or LiveView()
    for snapshot in snapshots:
        drawn = view.draw(snapshot)
    console = Console(width=width, no_color=not coloured, force_terminal=coloured or None)
    with console.capture() as captured:
        console.print(drawn)
    return captured.get()


ROW = VehicleRow(
    *(3, "quadrotor", "GUIDED", True, 47.4, 8.5, 488.0, 3, 12.3, 80.0, "field radio", 0.4, 0.02),
)
BOARD = NodeStatus(0, NodeId(1, 0), 0, (1, 4), 1, 7, 0, 12, 3, 450, 900, 100, 3290)
RECORDER = RecorderStatus("recording", "alps", 2, 81.0, 12_300_000, 4_100_000_000, "", "")
HOME = RelativeLocation(-7.76, 110.37, 150.0, 1234.4, 271.2)
MARK = RelativeLocation(-7.7, 110.3, 1.0, 88.0, 3.0)
WELL_KNOWN = replace(
    SNAPSHOT, aircraft=(AircraftStatus(1, FIX, HOME, MARK, (BOARD,)),), recorder=RECORDER
)
CLOSED = ListenerStats("udp-listen:[::]:5760", "", "closed", "Address already in use", 0, 0, 0)
RADIO = replace(CLIENT, name="radio", state="unreachable", reason="Permission denied")
TABLET_FAR = replace(CLIENT, name="tablet", remote="10.0.0.7:14550")
LATER = replace(SNAPSHOT, time_us=12_000_000, sent=((0, 12), (31, 600)))
NO_NODES = LinkReport(0, False, "auto", 0, 0, 0, (), (), None)
ARMING = replace(RECORDER, state="idle", mode="armed", held_s=41.6)
SHOWN = {
    "link, node, aircraft and client": ([SNAPSHOT], (
        "/dev/ttyUSB0 connected", "serial 1000 frames, 2 lost, 7 crc faults",
        "channel 76, noise 4 %", "1.0", "1.00", "-12.0", "270.0", "-7.765612", "5.0", "+1.5",
        "GPS rejected", "127.0.0.1:14550",
    )),
    "a single frame": (
        [replace(SNAPSHOT, report=msgspec.structs.replace(REPORT, frames=1))], (" 1 frame, ",)),
    "name of a client": ([replace(SNAPSHOT, clients=(TABLET_FAR,))], ("tablet 10.0.0.7:14550",)),
    "rates since the previous view": ([SNAPSHOT, LATER], ("ATTITUDE_QUATERNION", "50.0", "1.0")),
    "reasons of closed ports and clients": (
        [replace(SNAPSHOT, listeners=(CLOSED,), clients=(CLIENT, RADIO))],
        ("udp-listen:[::]:5760: Address already in use", "radio: Permission denied")),
    "no nodes": (
        [Snapshot(0, NO_NODES, (), (), (), HubCounters())],
        ("not connected (serial.port = auto)", "No aircraft yet")),
    "recorder": ([WELL_KNOWN], ("recording alps, part 2: 12.3 MB",)),
    "idle recorder": (
        [replace(WELL_KNOWN, recorder=replace(RECORDER, state="idle"))],
        ("recorder idle, 4.1 GB free",)),
    "recorder that waits for arming": (
        [replace(WELL_KNOWN, recorder=ARMING)],
        ("recorder waits for arming, 42 s in memory, 4.1 GB free",)),
    "recorder without a disk": (
        [replace(WELL_KNOWN, recorder=replace(RECORDER, reason="disk is full"))],
        ("not recorded: disk is full",)),
}  # fmt: skip
"""Snapshots, and texts of the view of the last one."""


@pytest.mark.parametrize("name", SHOWN)
def test_view_shows(name: str) -> None:
    snapshots, parts = SHOWN[name]
    text = text_of(*snapshots)
    assert [part for part in parts if part not in text] == []


def test_view_fits_a_terminal_of_80_by_24() -> None:
    far = msgspec.structs.replace(
        FLYING, lat_deg=-77.123456, lon_deg=-170.123456, alt_amsl_m=12_345.6
    )
    long = replace(CLIENT, sent=123_456_789, dropped=1_234_567, received=1_234_567)
    port = ListenerStats("udp-listen:127.0.0.1:14551", "", "open", "", 14551, 0, 0)
    sent = tuple((number, 9) for number in (0, 1, 2, 24, 29, 30, 31, 33, 42, 62, 74, 105, 230))
    full = replace(SNAPSHOT, states=((1, far),), clients=(long,), listeners=(port,), sent=sent)
    text = text_of(full, width=80)
    for part in ("-77.123456", "-170.123456", "12345.6", "123456789", "1234567", port.name):
        assert part in text
    assert "…" not in text
    assert len(text.splitlines()) <= 24


def test_unknown_position_is_shown_as_a_dash() -> None:
    lost = replace(SNAPSHOT, states=((1, LOST),))
    for text in (text_of(lost), summary_line(lost)):
        assert not any(word in text for word in ("nan", "None"))


def test_newest_log_lines_are_shown() -> None:
    view = LiveView()
    for number in range(20):
        record = logging.LogRecord("x", logging.WARNING, "", 0, "trouble %d", (number,), None)
        view.log.handle(record)
    text = text_of(SNAPSHOT, view=view)
    assert ("trouble 19" in text, "trouble 14" in text) == (True, False)


def test_summary_line_contains_receiver_nodes_aircraft_and_clients() -> None:
    assert summary_line(SNAPSHOT) == (
        "receiver: /dev/ttyUSB0 connected; aircraft 1.0 board 100 Hz 10 lost; "
        "aircraft 1 at -7.765612 110.372834 171.5 m, roll -12 pitch +3 yaw 270; 1 client"
    )


def test_router_shows_its_vehicles_and_no_receiver() -> None:
    """Without a receiver, which is not lost if it is not configured."""
    report = LinkReport(0, False, "none", 0, 0, 0, (), (), None)
    silent = replace(ROW, system_id=4, lat_deg=None, fix_type=0, age_s=9.0, armed=False)
    router = Snapshot(0, report, (), (), (), HubCounters(), vehicles=(ROW, silent))
    assert summary_line(router) == (
        "vehicle 3 (quadrotor) GUIDED armed at 47.400000, 8.500000 on field radio 2.0% lost; "
        "vehicle 4 (quadrotor) GUIDED disarmed no fix on field radio silent for 9.0 s 2.0% lost; "
        "0 clients"
    )
    text = text_of(router)
    assert ("receiver" in text, "serial" in text, "No aircraft" in text) == (False,) * 3
    assert "12.3 V 80 %" in text


FIGURES = {
    "V": "3.29", "bus": "12", "TX failed": "3", "retries": "450", "fw": "1.4",
    "fix": "3D", "satellites": "11", "±h m": "1.2", "home m": "1234", "home at°": "271",
    "mark m": "88", "mark at°": "3", "roll°": "-12.0", "longitude°": "110.372834",
}  # fmt: skip


@pytest.mark.parametrize("width", [200, 150, 100, 80, 60, 40], ids=lambda w: f"{w} columns")
def test_figures_are_below_their_headings_at_any_width(width: int) -> None:
    text = text_of(WELL_KNOWN, width=width)
    lines = text.splitlines()
    assert max(map(len, lines)) <= width
    for head, figure in FIGURES.items():
        at = next(i for i, line in enumerate(lines) if head in line)
        end = lines[at].index(head) + len(head)
        # A figure ends where its head does: none is cut off or shoved aside.
        assert lines[at + 1][:end].split()[-1] == figure, head


def test_wide_terminal_shows_clients_next_to_the_aircraft() -> None:
    wide, narrow = (text_of(WELL_KNOWN, width=w).splitlines() for w in (160, 100))
    (line,) = (line for line in wide if "lost %" in line)
    assert "client" in line
    assert len(wide) < len(narrow)


def test_invalid_fix_is_red() -> None:
    [known] = WELL_KNOWN.aircraft
    assert known.fix is not None
    lost = replace(known, fix=msgspec.structs.replace(known.fix, fix_ok=False))
    red = "\x1b[31mnone"
    assert red in text_of(replace(WELL_KNOWN, aircraft=(lost,)), coloured=True)
    assert "\x1b[31m3D" not in text_of(WELL_KNOWN, coloured=True)


def test_unknown_status_is_shown_as_dashes() -> None:
    unknown = AircraftStatus(1, None, None, RelativeLocation(1.0, 2.0, 3.0, None, None), ())
    lines = text_of(replace(SNAPSHOT, aircraft=(unknown,)), width=100).splitlines()
    for head in ("bus", "fix", "home m", "mark m", "mark at°"):
        at = next(i for i, line in enumerate(lines) if head in line)
        end = lines[at].index(head) + len(head)
        assert lines[at + 1][:end].split()[-1] == "—", head
