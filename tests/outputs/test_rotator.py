"""Directions of antennas, and rotators by hamlib's rotctld."""

import asyncio
import math
import os
import pty
import shutil
import tty
from contextlib import suppress
from typing import Any

import pytest
from pynmeagps import calc_checksum

from gateway.outputs.rotator import command
from gateway.vehicle_state.antenna import AntennaStation, Pointing, pointing_of
from gateway.vehicle_state.newest import NewestState
from gateway.vehicle_state.positions import Position
from tests.kit.messages import HERE, at, beat, gps, home
from tests.kit.process import START_LIMIT_S, running, until
from tests.outputs.conftest import OutputRig, connected
from tests.ports import free_port

EARTH_M = 6_371_000.0
STATION = "47.38774,-8.54559,488.13"
"""1112 m south of the vehicle, at its height."""


def pointing(station: tuple[float, float, float], there: tuple[float, float, float]) -> Any:
    state = NewestState()
    state.position, state.position_us = Position(*there), 0
    return pointing_of(AntennaStation(Position(*station)), state, {}, 0)


@pytest.mark.parametrize(
    ("there", "azimuth", "elevation", "distance"),
    [
        ((0.01, 0.0, 0.0), 0.0, -0.005, 1105.7),
        ((0.0, 0.01, 0.0), 90.0, -0.005, 1113.2),
        ((-0.01, 0.0, 1105.7), 180.0, 45.0, 1563.7),
        ((0.0, -0.01, 0.0), 270.0, -0.005, 1113.2),
    ],
)
def test_direction_and_distance_near_the_equator(
    there: tuple[float, float, float], azimuth: float, elevation: float, distance: float
) -> None:
    found = pointing((0.0, 0.0, 0.0), there)
    turn = (found.azimuth_deg - azimuth + 180.0) % 360.0 - 180.0
    assert turn == pytest.approx(0.0, abs=0.01)
    assert found.elevation_deg == pytest.approx(elevation, abs=0.01)
    assert found.distance_m == pytest.approx(distance, abs=0.3)


@pytest.mark.parametrize("distance_km", [10.0, 100.0])
def test_earth_curvature_lowers_a_distant_vehicle(distance_km: float) -> None:
    """At the same height it is half of the angle at the Earth's centre below the horizontal."""
    angle_deg = math.degrees(distance_km * 1e3 / EARTH_M)
    found = pointing(
        (47.0, 8.0, 1000.0), (47.0, 8.0 + angle_deg / math.cos(math.radians(47)), 1000.0)
    )
    assert found.elevation_deg == pytest.approx(-angle_deg / 2, rel=0.01)


@pytest.mark.parametrize("there", [(47.0, 8.0, 500.0), (47.0, 8.0, 501.0), (47.1, 8.0, math.nan)])
def test_no_direction_to_a_vehicle_at_the_station_or_of_unknown_height(
    there: tuple[float, float, float],
) -> None:
    assert pointing((47.0, 8.0, 500.0), there) is None


@pytest.mark.parametrize(
    ("protocol", "expected"),
    [("gs232", b"W124 004\r"), ("easycomm", b"AZ123.6 EL4.4\n"), ("rotctld", b"P 123.6 4.4\n")],
)
async def test_commands_follow_the_protocol(
    outputs: OutputRig, protocol: str, expected: bytes
) -> None:
    assert command(protocol, Pointing(123.6, 4.4, 1000.0)) == expected
    assert b"-" not in command(protocol, Pointing(0.0, -7.0, 1000.0))
    assert command(protocol, Pointing(359.99, 4.4, 1000.0)) == command(
        protocol, Pointing(0.0, 4.4, 1000.0)
    )


@pytest.mark.parametrize("kind", ["place", "home", "system"])
async def test_station_is_a_place_the_home_or_another_system(outputs: OutputRig, kind: str) -> None:
    option = {"place": STATION, "home": "home", "system": "system:9"}[kind]
    await outputs.udp("rotator", f"?protocol=rotctld&vehicle=2&station={option}")
    outputs.hear(beat(), at(HERE[0], HERE[1], HERE[2] + 1112), gps(), system=2)
    south = tuple(map(float, STATION.split(",")))
    if kind == "home":
        outputs.hear(home(*south), system=2)
    if kind == "system":
        assert await outputs.sends_nothing(), "the other system has no position"
        outputs.hear(beat(), at(*south), system=9)
    assert await outputs.sent() == b"P 0.0 45.0\n"
    outputs.clock.now_us = 6_000_000
    assert await outputs.sends_nothing(), "old"


async def test_direction_is_a_proprietary_sentence(outputs: OutputRig) -> None:
    await outputs.udp("nmea", f"?station={STATION}")
    outputs.hear(beat(), at())
    line = (await outputs.sent()).splitlines(keepends=True)[-1]
    body, _, checksum = line.decode().strip().lstrip("$").partition("*")
    assert checksum == calc_checksum(body)
    name, kind, azimuth, true, elevation, distance, unit = body.split(",")
    assert (name, kind, true, unit) == ("PMAVG", "POINT", "T", "M")
    assert float(azimuth) == pytest.approx(359.98)
    assert float(elevation) == pytest.approx(-0.005, abs=0.01)
    assert float(distance) == pytest.approx(1112, abs=1)


@pytest.mark.io
@pytest.mark.skipif(shutil.which("rotctld") is None, reason="needs hamlib's rotctld")
class TestHamlib:
    async def ask(self, port: int, text: str, lines: int) -> list[str]:
        reader, writer = await connected(port)
        try:
            writer.write(text.encode())
            return [(await reader.readline()).decode().strip() for _ in range(lines)]
        finally:
            writer.close()

    async def test_rotctld_turns_the_antenna_to_the_vehicle(self, outputs: OutputRig) -> None:
        port = free_port()
        with running("rotctld", "-m", 1, "-T", "127.0.0.1", "-t", port):
            async with asyncio.timeout(START_LIMIT_S):
                before = await self.ask(port, "p\n", 2)
                options = "protocol=rotctld&station=47.3977420,-8.6,488.13"
                await outputs.output(f"rotator:tcp:127.0.0.1:{port}?{options}")
                outputs.hear(beat(), at(alt_m=HERE[2] + 4106))
                outputs.turn()
                while (now := await self.ask(port, "p\n", 2)) == before:
                    await asyncio.sleep(0.01)
        # The dummy turns slowly from north; it is on its way to the east and up.
        assert float(now[0]) > float(before[0]) or float(now[1]) > float(before[1])

    @pytest.mark.parametrize(("model", "protocol"), [("603", "gs232"), ("202", "easycomm")])
    async def test_commands_equal_those_of_hamlib(self, model: str, protocol: str) -> None:
        main, line = pty.openpty()
        tty.setraw(line)
        os.set_blocking(main, False)
        port = free_port()
        device = os.ttyname(line)
        expected, received = command(protocol, Pointing(124.0, 45.0, 1e3)), bytearray()

        def is_received() -> bool:
            with suppress(BlockingIOError):
                received.extend(os.read(main, 4096))
            return expected in received

        with running("rotctld", "-m", model, "-r", device, "-T", "127.0.0.1", "-t", port):
            asking = asyncio.get_running_loop().create_task(self.ask(port, "P 124.0 45.0\n", 1))
            await until(is_received, 0.01)
            asking.cancel()
            await asyncio.wait([asking])
            # The connection closes in the next turn of the loop.
            await asyncio.sleep(0)
        for end in (main, line):
            os.close(end)
