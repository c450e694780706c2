"""Cursor on Target events, read by takproto."""

import asyncio
import ssl
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import takproto
from pymavlink.dialects.v20 import all as mavlink

from gateway.outputs.cot import UNKNOWN
from gateway.units import US_PER_S
from tests.kit.messages import HERE, at, beat, gps
from tests.outputs.conftest import UNIX_US, OutputRig
from tests.ports import free_port

BATTERY = mavlink.MAVLink_sys_status_message(0, 0, 0, 0, 12_400, -1, 80, 0, 0, 0, 0, 0, 0)


def read(data: bytes) -> Any:
    """Return the event as the parser of the TAK Protocol understands it."""
    return takproto.parse_proto(bytearray(data)).cotEvent


async def event(outputs: OutputRig, options: str, *messages: Any) -> Any:
    await outputs.udp("cot", options)
    outputs.hear(*messages)
    outputs.clock.now_us = US_PER_S // 2
    return read(await outputs.sent())


async def test_event_contains_position_motion_and_state(outputs: OutputRig) -> None:
    found = await event(outputs, "?callsign=Fish&vehicle=1", beat(), at(), gps(), BATTERY)
    assert (found.type, found.how) == ("a-f-A-M-H-Q", "m-g")
    assert (found.lat, found.lon) == pytest.approx(HERE[:2])
    assert found.hae == pytest.approx(488.1 + 47.5, abs=0.11)
    assert (found.ce, found.le) == (1.5, UNKNOWN)
    assert found.sendTime == found.startTime == UNIX_US // 1000
    assert found.staleTime - found.sendTime == 10_000
    detail = found.detail
    assert detail.contact.callsign == "Fish"
    assert (detail.track.speed, detail.track.course) == (5.0, 306.9)
    assert detail.status.battery == 80
    assert "LOITER, armed, 12.40 V, 80 %, 488 m AMSL, 20 m above home" in detail.xmlDetail
    assert found.uid.endswith(".1")


@pytest.mark.parametrize(
    ("kind", "autopilot", "mode", "expected", "words"),
    [
        (1, 3, 10, "a-f-A-M-F-Q", "AUTO"),
        (2, 12, 4 << 16 | 5 << 24, "a-f-A-M-H-Q", "RTL"),
        (2, 12, 3 << 16, "a-f-A-M-H-Q", "POSCTL"),
        (4, 3, 0, "a-f-A-M-H-Q", "STABILIZE"),
        (8, 0, 0, "a-f-A-M-L", ""),
        (10, 3, 4, "a-f-G-E-V", "HOLD"),
        (11, 3, 999, "a-f-S", ""),
        (12, 3, 999, "a-f-U", ""),
        (19, 0, 5, "a-f-A-M-F-Q", ""),
    ],
)
async def test_type_and_mode_follow_the_heartbeat(
    outputs: OutputRig, kind: int, autopilot: int, mode: int, expected: str, words: str
) -> None:
    found = await event(outputs, "", beat(kind, autopilot, mode, base_mode=0), at())
    assert found.type == expected
    remarks = ElementTree.fromstring(found.detail.xmlDetail).text or ""
    assert remarks.split(", ")[0] == (words or "disarmed")


async def test_height_above_ellipsoid_is_unknown_without_its_separation(outputs: OutputRig) -> None:
    found = await event(outputs, "", beat(), at())
    assert (found.hae, found.ce, found.le) == (UNKNOWN,) * 3


async def test_each_vehicle_with_a_valid_position_has_an_event(outputs: OutputRig) -> None:
    await outputs.udp("cot", "?callsign=%3CA%26&rate=0.1")
    for system in (1, 2, 3):
        outputs.hear(beat(), *([at()] if system != 2 else []), system=system)
    found = [read(await outputs.sent()), read(await outputs.target.receive())]
    assert [each.detail.contact.callsign for each in found] == ["<A& 1", "<A& 3"]
    assert found[0].staleTime - found[0].sendTime == 30_000
    outputs.clock.now_us = 6 * US_PER_S
    assert await outputs.sends_nothing(), "old"


async def test_events_for_a_server_are_lines_of_xml(outputs: OutputRig) -> None:
    output = await outputs.output(f"cot:tcp:127.0.0.1:{free_port()}")
    outputs.hear(beat(), at())
    (data,) = output.compose(0)
    assert data.endswith(b"</event>\n")
    assert read(data).lat == pytest.approx(HERE[0])


async def test_server_that_is_not_authentic_is_reported(
    outputs: OutputRig, certificate: Path
) -> None:
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.load_cert_chain(certificate)
    server = await asyncio.start_server(lambda *_: None, "127.0.0.1", 0, ssl=context)
    await outputs.output(f"cot:tls:127.0.0.1:{server.sockets[0].getsockname()[1]}")
    assert outputs.shown.state == "unreachable"
    assert "certificate" in outputs.shown.reason
    server.close()


async def test_missing_certificate_is_reported(outputs: OutputRig) -> None:
    await outputs.output("cot:tls:127.0.0.1:1?certificate=/no/such.pem")
    shown = outputs.shown
    assert (shown.state, shown.reason) == ("unreachable", "No such file or directory")
