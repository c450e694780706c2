"""The firmware's GPS parsers against pyubx2 and pynmeagps, which know the same formats."""

import ctypes
import math
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any, Final

import numpy as np
import pytest
from pynmeagps import NMEAMessage, NMEAReader
from pyubx2 import GET, UBXMessage, UBXReader

from firmware.rig.build import make
from firmware.rig.mcu import FIRMWARE
from gateway.records import GpsFixType
from gateway.wire.payloads import GpsFixPayload, GpsQualityPayload
from tests.kit.payloads import decode_payload

pytestmark = [pytest.mark.io, pytest.mark.slow]

TALKERS = ("GP", "GL", "GN")
Parse = Callable[[bytes], list[tuple[GpsFixPayload, GpsQualityPayload]]]
CAPACITY: Final = 2000
RANGE_ERROR_M: Final = 4.0
"""Per unit of dilution, as nmea.h has it."""


@pytest.fixture(scope="module")
def parse(build: Callable[..., Any]) -> Parse:
    make("gps-library")
    library = ctypes.CDLL(str(FIRMWARE / "build" / "libgps.so"))

    def run(data: bytes) -> list[tuple[GpsFixPayload, GpsQualityPayload]]:
        out = ctypes.create_string_buffer(64 * CAPACITY)
        count = library.gps_parse(data, len(data), out, CAPACITY)
        solutions = []
        for i in range(count):
            fix = decode_payload(out.raw[64 * i : 64 * i + 32])
            quality = decode_payload(out.raw[64 * i + 32 : 64 * i + 64])
            solutions.append((fix[1], quality[1]))
        return solutions

    return run


def itow_ms(utc: datetime) -> int:
    epoch = datetime(1980, 1, 6, tzinfo=UTC)
    return round((utc - epoch).total_seconds() * 1000 + 18_000) % 604_800_000


def held(value: float, limit: int = 65_535) -> int:
    return min(limit, math.ceil(value - 1e-9))


class TestUbx:
    @pytest.mark.parametrize("seed", range(4))
    def test_nav_pvt_fields_are_those_of_pyubx2(self, parse: Parse, seed: int) -> None:
        rng = np.random.default_rng(seed)
        messages = [self.random_pvt(rng) for _ in range(100)]
        noise = rng.integers(0, 256, 30).astype(np.uint8).tobytes().replace(b"\xb5", b"")
        solutions = parse(noise.join(message.serialize() for message in messages))
        assert len(solutions) == len(messages)
        for message, (fix, quality) in zip(messages, solutions, strict=True):
            read = UBXReader.parse(message.serialize())
            assert fix.itow_ms == quality.itow_ms == read.iTOW
            location = (round(read.lat * 1e7), round(read.lon * 1e7), read.hMSL)
            assert (fix.lat_dege7, fix.lon_dege7, fix.alt_amsl_mm) == location
            assert fix.vel_n_cmps == tuple(
                max(-32_767, min(32_767, math.trunc(v / 10)))
                for v in (read.velN, read.velE, read.velD)
            )
            assert fix.fix_type == GpsFixType(read.fixType)
            assert (fix.fix_ok, fix.satellites) == (bool(read.gnssFixOk), read.numSV)
            errors = (quality.h_acc_cm, quality.v_acc_cm, quality.speed_acc_cmps)
            assert errors == tuple(held(v / 10) for v in (read.hAcc, read.vAcc, read.sAcc))
            assert quality.course_acc_cdeg == held(round(read.headAcc * 1e5) / 1000)
            assert quality.pdop_centi == round(read.pDOP * 100)
            date, time = (read.year, read.month, read.day), (read.hour, read.min, read.second)
            assert quality.utc is not None
            assert quality.utc.timetuple()[:6] == (*date, *time)

    @staticmethod
    def random_pvt(rng: np.random.Generator) -> UBXMessage:
        return UBXMessage(
            "NAV", "NAV-PVT", GET,
            iTOW=int(rng.integers(0, 604_800_000)),
            year=int(rng.integers(2024, 2100)), month=int(rng.integers(1, 13)),
            day=int(rng.integers(1, 29)), hour=int(rng.integers(0, 24)),
            min=int(rng.integers(0, 60)), second=int(rng.integers(0, 60)),
            validDate=1, validTime=1, fullyResolved=1, nano=int(rng.integers(0, 999_999_999)),
            fixType=int(rng.integers(0, 6)), gnssFixOk=int(rng.integers(0, 2)),
            numSV=int(rng.integers(0, 40)),
            lat=float(rng.uniform(-90, 90)), lon=float(rng.uniform(-180, 180)),
            height=int(rng.integers(-400_000, 20_000_000)),
            hMSL=int(rng.integers(-400_000, 20_000_000)),
            hAcc=int(rng.integers(0, 5_000_000)), vAcc=int(rng.integers(0, 5_000_000)),
            velN=int(rng.integers(-500_000, 500_000)), velE=int(rng.integers(-500_000, 500_000)),
            velD=int(rng.integers(-500_000, 500_000)), sAcc=int(rng.integers(0, 100_000)),
            headAcc=float(rng.uniform(0, 180)), pDOP=float(rng.uniform(0, 99)),
        )  # fmt: skip

    def test_u_blox_6_sends_a_solution_in_four_messages(self, parse: Parse) -> None:
        parts = [
            UBXMessage(
                "NAV", "NAV-POSLLH", GET, iTOW=345_600_200, lon=110.3654321, lat=-7.7123456,
                height=176_700, hMSL=153_250, hAcc=1799, vAcc=3100,
            ),
            UBXMessage(
                "NAV", "NAV-SOL", GET, iTOW=345_600_200, gpsFix=3, gpsfixOK=1, pDOP=1.61, numSV=9
            ),
            UBXMessage(
                "NAV", "NAV-VELNED", GET, iTOW=345_600_200, velN=1234, velE=-567, velD=-89,
                sAcc=42, cAcc=2.75,
            ),
            UBXMessage(
                "NAV", "NAV-TIMEUTC", GET, iTOW=345_600_200, nano=200_000_000, year=2026, month=11,
                day=19, hour=0, min=0, sec=2, validUTC=1,
            ),
        ]  # fmt: skip
        whole = b"".join(part.serialize() for part in parts)
        late = UBXMessage("NAV", "NAV-POSLLH", GET, iTOW=345_600_400, lat=1.0).serialize()
        # An epoch of which a part is missing is dropped, the next one is complete.
        solutions = parse(late + whole + whole[: len(whole) // 2] + whole)
        assert len(solutions) == 2
        fix, quality = solutions[0]
        assert solutions[1] == solutions[0]
        assert (fix.lat_dege7, fix.lon_dege7) == (-77_123_456, 1_103_654_321)
        assert fix.alt_amsl_mm == 153_250
        assert fix.vel_n_cmps == (1234, -567, -89)
        assert (fix.fix_type, fix.fix_ok, fix.satellites) == (GpsFixType.FIX_3D, True, 9)
        assert (quality.h_acc_cm, quality.v_acc_cm, quality.speed_acc_cmps) == (180, 310, 42)
        others = (quality.course_acc_cdeg, quality.pdop_centi, quality.geoid_separation_cm)
        assert others == (275, 161, 2345)
        assert quality.utc == datetime(2026, 11, 19, 0, 0, 2, 200_000, tzinfo=UTC)


class Epoch:
    """One second of a receiver, and its sentences as pynmeagps writes and reads them."""

    def __init__(self, rng: np.random.Generator) -> None:
        moment = int(rng.integers(1_735_689_600, 2_200_000_000)) + int(rng.integers(0, 10)) / 10
        self.utc = datetime.fromtimestamp(moment, UTC)
        self.lat, self.lon = float(rng.uniform(-89.9, 89.9)), float(rng.uniform(-179.9, 179.9))
        self.alt_m = round(float(rng.uniform(-400, 9000)), 1)
        self.geoid_m = round(float(rng.uniform(-100, 80)), 1)
        self.knots = round(float(rng.uniform(0, 300)), 3)
        self.course_deg = round(float(rng.uniform(0, 359.99)), 2)
        self.satellites = int(rng.integers(4, 30))
        self.hdop, self.vdop, self.pdop = (round(float(v), 2) for v in rng.uniform(0.5, 9, 3))

    def rmc(self, talker: str = "GN", status: str = "A") -> bytes:
        return NMEAMessage(
            talker, "RMC", GET, time=self.utc.time(), status=status, lat=self.lat, lon=self.lon,
            spd=self.knots, cog=self.course_deg, date=self.utc.date(), posMode="A",
            hpnmeamode=1,
        ).serialize()  # fmt: skip

    def gga(self, talker: str = "GN", quality: int = 1) -> bytes:
        return NMEAMessage(
            talker, "GGA", GET, time=self.utc.time(), lat=self.lat, lon=self.lon, quality=quality,
            numSV=self.satellites, HDOP=self.hdop, alt=self.alt_m, altUnit="M", sep=self.geoid_m,
            sepUnit="M", hpnmeamode=1,
        ).serialize()  # fmt: skip

    def gsa(self, talker: str = "GN", nav_mode: int = 3) -> bytes:
        return NMEAMessage(
            talker, "GSA", GET, opMode="A", navMode=nav_mode, PDOP=self.pdop, HDOP=self.hdop,
            VDOP=self.vdop,
        ).serialize()  # fmt: skip


class TestNmea:
    @pytest.mark.parametrize("seed", range(4))
    def test_fields_are_those_of_pynmeagps(self, parse: Parse, seed: int) -> None:
        rng = np.random.default_rng(seed)
        epochs = [Epoch(rng) for _ in range(100)]
        sentences = [
            b"".join(rng.permutation([e.gsa(), e.gga()]).tolist()) + e.rmc() for e in epochs
        ]
        solutions = parse(b"$GNTXT,01,01,02,hello*00\r\n".join(sentences))
        assert len(solutions) == len(epochs)
        for epoch, (fix, quality) in zip(epochs, solutions, strict=True):
            gga, rmc = NMEAReader.parse(epoch.gga()), NMEAReader.parse(epoch.rmc())
            assert fix.lat_dege7 == pytest.approx(gga.lat * 1e7, abs=1)
            assert fix.lon_dege7 == pytest.approx(gga.lon * 1e7, abs=1)
            assert fix.alt_amsl_mm == round(gga.alt * 1000)
            assert quality.geoid_separation_cm == pytest.approx(gga.sep * 100, abs=1)
            speed_cmps, course = rmc.spd * 51.4444, math.radians(rmc.cog)
            assert fix.vel_n_cmps[0] == pytest.approx(speed_cmps * math.cos(course), abs=1)
            assert fix.vel_n_cmps[1] == pytest.approx(speed_cmps * math.sin(course), abs=1)
            assert (fix.fix_type, fix.fix_ok) == (GpsFixType.FIX_3D, True)
            assert fix.satellites == gga.numSV
            assert fix.itow_ms == quality.itow_ms == itow_ms(epoch.utc)
            assert quality.utc == epoch.utc
            assert quality.h_acc_cm == pytest.approx(100 * RANGE_ERROR_M * gga.HDOP, abs=1)
            assert quality.v_acc_cm == pytest.approx(100 * RANGE_ERROR_M * epoch.vdop, abs=1)
            assert quality.pdop_centi == round(epoch.pdop * 100)

    @pytest.mark.parametrize("order", ["rmc gga gsa", "gga gsa rmc", "gsa rmc gga"])
    def test_several_talkers_give_one_fix_each_second(self, parse: Parse, order: str) -> None:
        rng = np.random.default_rng(5)
        epochs = [Epoch(rng) for _ in range(5)]
        sentences = [(e, each) for e in epochs for each in order.split()]
        solutions = parse(b"".join(getattr(e, s)(t) for e, s in sentences for t in TALKERS))
        assert [fix.itow_ms for fix, _ in solutions] == [itow_ms(e.utc) for e in epochs]

    @pytest.mark.parametrize(
        ("status", "quality", "nav_mode", "fix_type", "ok"),
        [
            ("A", 1, 3, GpsFixType.FIX_3D, True),
            ("A", 2, 2, GpsFixType.FIX_2D, True),
            ("A", 6, 3, GpsFixType.DEAD_RECKONING, False),
            ("A", 1, 1, GpsFixType.NONE, False),
            ("V", 1, 3, GpsFixType.NONE, False),
            ("A", 0, 3, GpsFixType.NONE, False),
        ],
    )
    def test_fix_type_comes_from_all_three_sentences(
        self, parse: Parse, status: str, quality: int, nav_mode: int, fix_type: GpsFixType, ok: bool
    ) -> None:
        epoch = Epoch(np.random.default_rng(1))
        data = epoch.gsa(nav_mode=nav_mode) + epoch.gga(quality=quality) + epoch.rmc(status=status)
        ((fix, _),) = parse(data)
        assert (fix.fix_type, fix.fix_ok) == (fix_type, ok)

    @pytest.mark.parametrize("modes", [(3, 1), (1, 3), (3, 2, 1), (2, 3)])
    def test_best_gsa_of_several_constellations_counts(
        self, parse: Parse, modes: tuple[int, ...]
    ) -> None:
        epoch = Epoch(np.random.default_rng(1))
        data = b""
        for mode in modes:
            # The dilutions of a constellation without a fix are better here, and do not count.
            epoch.pdop, epoch.vdop = (1.6, 1.3) if mode == 3 else (0.5, 0.5)
            data += epoch.gsa(nav_mode=mode)
        epoch.pdop = epoch.vdop = 99.99
        data += epoch.gsa(nav_mode=3) + epoch.gga() + epoch.rmc()
        ((fix, quality),) = parse(data)
        assert (fix.fix_type, fix.fix_ok) == (GpsFixType.FIX_3D, True)
        assert (quality.pdop_centi, quality.v_acc_cm) == (160, 130 * RANGE_ERROR_M)

    def test_velocity_down_is_the_difference_of_two_heights(self, parse: Parse) -> None:
        first, second = Epoch(np.random.default_rng(1)), Epoch(np.random.default_rng(1))
        second.utc = first.utc.replace(second=(first.utc.second + 1) % 60)
        first.utc = second.utc.replace(second=second.utc.second - 1)
        second.alt_m = round(first.alt_m + 2.5, 1)
        (_, _), (fix, _) = parse(first.gga() + first.rmc() + second.gga() + second.rmc())
        assert fix.vel_n_cmps[2] == -250

    @pytest.mark.parametrize(
        "sentences",
        [
            b"$GNRMC,,V,,,,,,,,,,N*4D\r\n$GNGGA,,,,,,0,00,99.99,,,,,,*56\r\n",
            b"$GPGGA,,,,,,0,00,25.5,,,,,,*7A\r\n$GPRMC,,V,,,,,,,,,,N*53\r\n",
        ],
    )
    def test_receiver_without_a_fix_reports_none(self, parse: Parse, sentences: bytes) -> None:
        ((fix, quality),) = parse(sentences)
        assert (fix.fix_type, fix.fix_ok, fix.satellites) == (GpsFixType.NONE, False, 0)
        assert quality.utc is None

    def test_flipped_bit_never_gives_a_wrong_fix(self, parse: Parse) -> None:
        epoch = Epoch(np.random.default_rng(2))
        good = epoch.gga() + epoch.rmc()
        ((expected, quality),) = parse(good)
        for bit in range(len(good) * 8):
            broken = bytearray(good)
            broken[bit // 8] ^= 1 << bit % 8
            for solution in parse(bytes(broken)):
                assert solution == (expected, quality)

    @pytest.mark.parametrize("seed", range(3))
    def test_garbage_gives_nothing_and_the_next_fix_is_found(self, parse: Parse, seed: int) -> None:
        rng = np.random.default_rng(seed)
        epoch = Epoch(rng)
        garbage = rng.integers(0, 256, 20_000).astype(np.uint8).tobytes()
        printable = bytes(rng.choice(list(b"$GNRMCA*,.0123456789"), 20_000).tolist())
        # The UBX reader may be inside a message that was never sent; the driver ends it by its gap.
        solutions = parse(printable + garbage + b"\0" * 500 + epoch.gga() + epoch.rmc())
        assert [fix.lat_dege7 for fix, _ in solutions] == [pytest.approx(epoch.lat * 1e7, abs=100)]
