"""u-blox NEO-M8N on a serial line: NMEA at 9600 baud until it is told otherwise.

u-blox 8 / M8 receiver description including protocol specification, revision 2018.
"""

import struct
from collections.abc import Callable
from datetime import timedelta
from typing import Final

import numpy as np

from firmware.rig.bench import PS_PER_S, Bench
from firmware.rig.world import START_ITOW_MS, START_UTC, Solution, World

FACTORY_BAUD: Final = 9600
COMPUTING_S: Final = 0.03
"""From the moment a solution is valid for to its first byte."""
BAUD_TOLERANCE: Final = 0.03
"""Two ends further apart than this read garbage."""

_NAV_PVT: Final = struct.Struct("<IHBBBBBBIiBBBBiiiiIIiiiiiIIH6xihH")
_ACK_ACK, _ACK_NAK = 0x01, 0x00
_CFG_PRT, _CFG_MSG, _CFG_RATE, _CFG_NAV5 = 0x00, 0x01, 0x08, 0x24
_NMEA: Final = b"$GNRMC,,V,,,,,,,,,,N*4D\r\n$GNGGA,,,,,,0,00,99.99,,,,,,*56\r\n"


def ubx(message_class: int, identifier: int, payload: bytes) -> bytes:
    """Build a UBX message."""
    body = bytes([message_class, identifier]) + len(payload).to_bytes(2, "little") + payload
    a = b = 0
    for byte in body:
        a = (a + byte) & 0xFF
        b = (b + a) & 0xFF
    return b"\xb5\x62" + body + bytes([a, b])


def nav_pvt(time_s: float, fix: Solution) -> bytes:
    """Build the payload of a UBX-NAV-PVT."""
    utc = START_UTC + timedelta(seconds=time_s)
    valid = 0x37 if fix.satellites else 0x00
    north, east, down = (round(v * 1000) for v in fix.vel_n_mps)
    speed = round(float(np.hypot(north, east)))
    height = round((fix.alt_amsl_m + fix.geoid_separation_m) * 1000)
    return _NAV_PVT.pack(
        START_ITOW_MS + round(time_s * 1000), utc.year, utc.month, utc.day, utc.hour, utc.minute,
        utc.second, valid, 30, utc.microsecond * 1000, fix.fix_type, int(fix.fix_ok), 0,
        fix.satellites, round(fix.lon_deg * 1e7), round(fix.lat_deg * 1e7), height,
        round(fix.alt_amsl_m * 1000), round(fix.h_acc_m * 1000), round(fix.v_acc_m * 1000), north, east, down, speed, 0, round(fix.speed_acc_mps * 1000),
        round(fix.course_acc_deg * 1e5), round(fix.pdop * 100), 0, 0, 0,
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
    ) -> None:
        self._bench, self._world, self._rng = bench, world, rng
        self._feed, self._board_baud = feed, board_baud
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
        self._generation += 1
        self._schedule(self._generation)

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
            self._generation += 1
            self._schedule(self._generation)
        elif identifier == _CFG_NAV5 and len(payload) == 36 and payload[0] & 1:
            self.dynamic_model = payload[2]
        else:
            known = False
        answer = ubx(0x05, _ACK_ACK if known else _ACK_NAK, bytes([0x06, identifier]))
        self._say(answer, before)

    def _schedule(self, generation: int) -> None:
        now_s = self._bench.now_ps / PS_PER_S
        epoch_s = (int(now_s / self.period_s + 1e-9) + 1) * self.period_s

        def solve() -> None:
            if generation == self._generation:
                self._report(epoch_s)
                self._schedule(generation)

        self._bench.at(round((epoch_s + COMPUTING_S) * PS_PER_S), solve)

    def _report(self, epoch_s: float) -> None:
        if not self.ubx_only:
            self._say(_NMEA)
        if self.pvt_on:
            self._say(ubx(0x01, 0x07, nav_pvt(epoch_s, self._world.solution(epoch_s))))

    def _say(self, data: bytes, baud: int | None = None) -> None:
        if self.absent:
            return
        byte_ps = 10 * PS_PER_S // (baud or self.baud)
        at_ps = max(self._bench.now_ps, self._line_free_ps)
        for byte in data:
            self._bench.at(at_ps, lambda byte=byte: self._feed(self._through_line(byte)))
            at_ps += byte_ps
        self._line_free_ps = at_ps

    def _through_line(self, byte: int) -> int:
        apart = abs(self._board_baud() / self.baud - 1)
        return byte if apart < BAUD_TOLERANCE else int(self._rng.integers(0, 256))
