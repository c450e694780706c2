"""NMEA sentences, read by pynmeagps and by gpsd."""

import asyncio
import json
import shutil
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink
from pynmeagps import NMEAReader

from gateway.hub.endpoint import parse_endpoint
from gateway.units import US_PER_S
from gateway.vehicle_state.newest import POSITION_OLD_US
from tests.kit.messages import HERE, at, beat, estimator, gps
from tests.kit.process import START_LIMIT_S, running
from tests.outputs.conftest import OutputRig, connected
from tests.ports import free_port

ABSOLUTE = mavlink.ESTIMATOR_POS_HORIZ_ABS


def read(data: bytes) -> dict[str, Any]:
    """Parse each sentence strictly; return them by their names."""
    lines = data.decode("ascii").splitlines(keepends=True)
    parsed = [NMEAReader.parse(line.encode(), msgmode=0, validate=1) for line in lines]
    return {message.msgID: message for message in parsed}


async def sentences(outputs: OutputRig) -> dict[str, Any]:
    return read(await outputs.sent())


async def test_sentences_contain_position_motion_and_heading(outputs: OutputRig) -> None:
    output = await outputs.udp("nmea")
    outputs.clock.now_us = 3 * US_PER_S
    outputs.hear(beat(), at(), gps())
    outputs.clock.now_us += US_PER_S // 2
    found = await sentences(outputs)
    assert list(found) == ["GGA", "RMC", "VTG", "HDT"]
    gga, rmc, vtg, hdt = found.values()
    assert (gga.lat, gga.lon) == pytest.approx(HERE[:2], abs=2e-7)
    assert (gga.quality, gga.numSV, gga.HDOP, gga.alt, gga.sep) == (1, 11, 1.2, 488.1, 47.5)
    assert str(gga.time) == str(rmc.time) == "12:03:07.560000", "the position's, not the present"
    assert (str(rmc.date), rmc.status, rmc.posMode) == ("2024-06-01", "A", "A")
    assert rmc.spd == pytest.approx(5 * 3600 / 1852, abs=0.05)
    assert rmc.cog == vtg.cogt == pytest.approx(306.9, abs=0.05)
    assert vtg.sogk == pytest.approx(18.0)
    assert hdt.headingT == 90.5
    assert output.counters.sent == 1


POSITIONS: dict[str, tuple[list[Any], int, bool]] = {
    "new": ([at()], 0, True),
    "just new enough": ([at()], POSITION_OLD_US, True),
    "old": ([at()], POSITION_OLD_US + 1, False),
    "zero": ([at(0.0, 0.0)], 0, False),
    "beyond the pole": ([at(95.0, 0.0)], 0, False),
    "GPS without a fix": ([gps(kind=1)], 0, False),
    "GPS with a 2D fix": ([gps(kind=2)], 0, True),
    "absolute": ([at(), estimator(ABSOLUTE)], 0, True),
    "not absolute": ([at(), estimator(0)], 0, False),
    "constant": ([at(), estimator(ABSOLUTE | mavlink.ESTIMATOR_CONST_POS_MODE)], 0, False),
    "GPS and an estimator without a position": ([gps(), estimator(0)], 0, True),
    "none": ([], 0, False),
}


@pytest.mark.parametrize("name", POSITIONS)
async def test_position_is_void_unless_valid_and_new(outputs: OutputRig, name: str) -> None:
    messages, age_us, is_valid = POSITIONS[name]
    await outputs.udp("nmea")
    outputs.hear(beat(), *messages)
    outputs.clock.now_us = age_us
    found = await sentences(outputs)
    gga, rmc = found["GGA"], found["RMC"]
    assert (gga.quality > 0, rmc.status == "A", "VTG" in found) == (is_valid,) * 3
    assert (gga.lat == "") == (rmc.lat == "") == (not is_valid)


@pytest.mark.parametrize(
    ("lat_deg", "lon_deg", "written"),
    [
        (59.999_999_99, -179.999_999_99, "6000.00000,N,18000.00000,W"),
        (-0.5, 0.000_001, "0030.00000,S,00000.00006,E"),
    ],
)
async def test_minutes_are_carried_and_hemispheres_are_right(
    outputs: OutputRig, lat_deg: float, lon_deg: float, written: str
) -> None:
    await outputs.udp("nmea")
    outputs.hear(beat(), at(lat_deg, lon_deg))
    assert written in (await outputs.sent()).decode()


@pytest.mark.parametrize(
    ("kind", "quality"), [(0, 6), (1, 6), (2, 1), (3, 1), (4, 2), (5, 5), (6, 4), (8, 1)]
)
async def test_quality_follows_the_type_of_the_fix(
    outputs: OutputRig, kind: int, quality: int
) -> None:
    await outputs.udp("nmea")
    outputs.hear(beat(), at(), gps(kind=kind))
    assert (await sentences(outputs))["GGA"].quality == quality


async def test_one_vehicle_of_several_is_sent(outputs: OutputRig) -> None:
    output = await outputs.udp("nmea")
    assert await outputs.sends_nothing(), "no vehicle yet"
    for system in (9, 7):
        outputs.hear(beat(), at(lat_deg=float(system)), system=system)
    outputs.hear(at(lat_deg=3.0), system=7, component=154)
    outputs.hear(at(lat_deg=1.0), system=255)
    assert (await sentences(outputs))["GGA"].lat == 7.0
    output.reconfigure(parse_endpoint(f"{output.endpoint.url}?vehicle=9&rate=4"))
    assert output.interval_s == 0.25
    assert (await sentences(outputs))["GGA"].lat == 9.0


async def test_sentences_are_sent_at_the_rate_of_the_endpoint(outputs: OutputRig) -> None:
    station = outputs.station()
    outputs.of_hub = await outputs.open(f"nmea:udp:127.0.0.1:{station.port}?rate=50")
    outputs.hear(beat(), at())
    while read(await station.receive())["RMC"].status != "A":
        pass
    assert read(await station.receive())["RMC"].status == "A"


async def test_filters_of_the_endpoint_apply(outputs: OutputRig) -> None:
    await outputs.udp("nmea", "?deny=GLOBAL_POSITION_INT&allow=GPS_RAW_INT")
    outputs.hear(beat(), at(lat_deg=3.0), gps())
    found = await sentences(outputs)
    assert found["GGA"].lat == pytest.approx(HERE[0], abs=2e-7)
    assert "HDT" not in found


@pytest.mark.io
@pytest.mark.skipif(shutil.which("gpsd") is None, reason="needs gpsd")
async def test_gpsd_reports_the_position(outputs: OutputRig) -> None:
    output = await outputs.output("nmea:tcp-listen:127.0.0.1:0")
    source, port = output.carrier.link.port, free_port()
    with running("gpsd", "-N", "-n", "-b", "-S", port, f"tcp://127.0.0.1:{source}"):
        async with asyncio.timeout(START_LIMIT_S):
            report = await first_fix(outputs, port)
    assert (report["lat"], report["lon"]) == pytest.approx(HERE[:2], abs=2e-7)
    assert report["altMSL"] == pytest.approx(488.1)
    assert report["geoidSep"] == pytest.approx(47.5)
    assert report["speed"] == pytest.approx(5.0, abs=0.03)
    assert report["track"] == pytest.approx(306.9)


async def first_fix(outputs: OutputRig, port: int) -> Any:
    """Return the first report of gpsd with a position and a speed."""
    reader, writer = await connected(port)
    writer.write(b'?WATCH={"enable":true,"json":true};\n')
    reading = asyncio.get_running_loop().create_task(reader.readline())
    try:
        while True:
            outputs.clock.now_us += US_PER_S
            outputs.hear(beat(), at(), gps())
            outputs.turn()
            done, _ = await asyncio.wait([reading], timeout=0.05)
            if not done:
                continue
            report = json.loads(reading.result())
            if report["class"] == "TPV" and {"lat", "track", "altMSL"} <= report.keys():
                return report
            reading = asyncio.get_running_loop().create_task(reader.readline())
    finally:
        reading.cancel()
        writer.close()
