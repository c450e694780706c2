"""u-blox NEO-M8N on a serial line: NMEA at 9600 baud until it is configured.

u-blox 8 / M8 receiver description including protocol specification, revision 2018.
"""

import struct
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from functools import partial
from typing import Final

import numpy as np

from firmware.rig.bench import PS_PER_S, Bench
from firmware.rig.world import Solution, World

FACTORY_BAUD: Final = 9600
COMPUTING_S: Final = 0.15
"""From the moment a solution is valid for to its first byte."""
BAUD_TOLERANCE: Final = 0.03
"""Two ends further apart than this read garbage."""

_NAV_PVT: Final = struct.Struct("<IHBBBBBBIiBBBBiiiiIIiiiiiIIH6xihH")
_ACK_ACK, _ACK_NAK = 0x01, 0x00
_CFG_PRT, _CFG_MSG, _CFG_RATE, _CFG_NAV5 = 0x00, 0x01, 0x08, 0x24
_UNIX_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
_GPS_EPOCH_UNIX_US: Final = 315_964_800_000_000
_LEAP_US: Final = 18_000_000
_WEEK_MS: Final = 604_800_000
_NMEA: Final = b"$GNRMC,,V,,,,,,,,,,N*4D\r\n$GNGGA,,,,,,0,00,99.99,,,,,,*56\r\n"


def ubx(message_class: int, identifier: int, payload: bytes) -> bytes:
    """Build a UBX message."""
    body = bytes([message_class, identifier]) + len(payload).to_bytes(2, "little") + payload
    a = b = 0
    for byte in body:
        a = (a + byte) & 0xFF
        b = (b + a) & 0xFF
    return b"\xb5\x62" + body + bytes([a, b])


def nav_pvt(unix_us: int, fix: Solution) -> bytes:
    """Build the payload of a UBX-NAV-PVT."""
    utc = _UNIX_EPOCH + timedelta(microseconds=unix_us)
    itow_ms = (unix_us - _GPS_EPOCH_UNIX_US + _LEAP_US) // 1000 % _WEEK_MS
    valid = 0x37 if fix.time_valid else 0x00
    north, east, down = (round(v * 1000) for v in fix.vel_n_mps)
    speed = round(float(np.hypot(north, east)))
    height = round((fix.alt_amsl_m + fix.geoid_separation_m) * 1000)
    clock = (utc.year, utc.month, utc.day, utc.hour, utc.minute, utc.second)
    time_accuracy_ns, nano = 30, utc.microsecond * 1000
    lon_dege7, lat_dege7 = round(fix.lon_deg * 1e7), round(fix.lat_deg * 1e7)
    h_acc, v_acc, speed_acc = (
        round(v * 1000) for v in (fix.h_acc_m, fix.v_acc_m, fix.speed_acc_mps)
    )
    course_acc, pdop = round(fix.course_acc_deg * 1e5), round(fix.pdop * 100)
    return _NAV_PVT.pack(
        itow_ms, *clock, valid, time_accuracy_ns, nano, fix.fix_type, int(fix.fix_ok), 0,
        fix.satellites, lon_dege7, lat_dege7, height, round(fix.alt_amsl_m * 1000), h_acc, v_acc,
        north, east, down, speed, 0, speed_acc, course_acc, pdop, 0, 0, 0,
    )  # fmt: skip


class M8n:
    """The receiver.

    Parameters
    ----------
    bench : Bench
    world : World
    rng : numpy.random.Generator
    feed : callable
        Starts one byte on the board's receive line.
    board_baud : callable
        The speed that the board has set, for what it hears and says.
    """

    def __init__(
        self,
        bench: Bench,
        world: World,
        rng: np.random.Generator,
        feed: Callable[[int], None],
        board_baud: Callable[[], float],
        computing_s: float = COMPUTING_S,
    ) -> None:
        self._bench, self._world, self._rng = bench, world, rng
        self._feed, self._board_baud = feed, board_baud
        self._computing_s = computing_s
        self.absent = False
        self._line_free_ps = 0
        self._generation = 0
        self.reset()

    def reset(self) -> None:
        """Fall back to the factory's settings, as when the backup supply was lost."""
        self.baud = FACTORY_BAUD
        self.period_s = 1.0
        self.dynamic_model = 0
        self.ubx_only = self.pvt_on = False
        self._in = b""
        self._begin_solutions()

    def say_garbage(self, size: int) -> None:
        """Put bytes of noise on the line."""
        self._say(self._rng.integers(0, 256, size).astype(np.uint8).tobytes())

    def hear(self, byte: int) -> None:
        """Take a byte that the board sent."""
        if self.absent:
            return
        self._in = (self._in + bytes([self._through_line(byte)]))[-200:]
        start = self._in.find(b"\xb5\x62")
        if start < 0 or len(self._in) < start + 8:
            return
        size = int.from_bytes(self._in[start + 4 : start + 6], "little")
        if size > 100:
            self._in = self._in[start + 2 :]
            return
        message = self._in[start : start + 8 + size]
        if len(message) < 8 + size:
            return
        self._in = self._in[start + 8 + size :]
        if ubx(message[2], message[3], message[6:-2]) == message and message[2] == 0x06:
            self._configure(message[3], message[6:-2])

    def _configure(self, identifier: int, payload: bytes) -> None:
        known = True
        before = self.baud
        if identifier == _CFG_PRT and len(payload) == 20 and payload[0] == 1:
            self.baud = int.from_bytes(payload[8:12], "little")
            self.ubx_only = int.from_bytes(payload[14:16], "little") == 1
        elif identifier == _CFG_MSG and len(payload) == 3:
            self.pvt_on = payload[:2] == b"\x01\x07" and payload[2] == 1
        elif identifier == _CFG_RATE and len(payload) == 6:
            self.period_s = int.from_bytes(payload[:2], "little") / 1000
            self._begin_solutions()
        elif identifier == _CFG_NAV5 and len(payload) == 36 and payload[0] & 1:
            self.dynamic_model = payload[2]
        else:
            known = False
        answer = ubx(0x05, _ACK_ACK if known else _ACK_NAK, bytes([0x06, identifier]))
        self._say(answer, before)

    def _begin_solutions(self) -> None:
        """Solve from the next whole period on; solutions under way are forgotten."""
        self._generation += 1
        number = int(self._bench.now_ps / PS_PER_S / self.period_s + 1e-9) + 1
        self._schedule(self._generation, number)

    def _schedule(self, generation: int, number: int) -> None:
        epoch_s = number * self.period_s

        def solve() -> None:
            if generation == self._generation:
                self._report(epoch_s)
                self._schedule(generation, number + 1)

        self._bench.at(round((epoch_s + self._computing_s) * PS_PER_S), solve)

    def _report(self, epoch_s: float) -> None:
        if not self.ubx_only:
            self._say(_NMEA)
        if self.pvt_on:
            unix_us = self._world.start_unix_us + round(epoch_s * 1e6)
            self._say(ubx(0x01, 0x07, nav_pvt(unix_us, self._world.solution(epoch_s))))

    def _say(self, data: bytes, baud: int | None = None) -> None:
        if self.absent:
            return
        byte_ps = 10 * PS_PER_S // (baud or self.baud)
        at_ps = max(self._bench.now_ps, self._line_free_ps)
        for byte in data:
            self._bench.at(at_ps, partial(self._pass_byte, byte))
            at_ps += byte_ps
        self._line_free_ps = at_ps

    def _pass_byte(self, byte: int) -> None:
        self._feed(self._through_line(byte))

    def _through_line(self, byte: int) -> int:
        apart = abs(self._board_baud() / self.baud - 1)
        return byte if apart < BAUD_TOLERANCE else int(self._rng.integers(0, 256))
