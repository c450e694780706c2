"""GPS receivers on a serial line: u-blox 6 to 10, some of their look-alikes, and plain NMEA.

u-blox 6, 7, 8 / M8 receiver descriptions including protocol specification; u-blox F9 and M10
interface descriptions.
"""

import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import partial
from typing import Final

import numpy as np

from firmware.rig.bench import PS_PER_S, STEP_PS, Bench
from firmware.rig.serial_line import LineSampler
from firmware.rig.world import Solution, World

COMPUTING_S: Final = 0.15
"""From the moment a solution is valid for to its first byte."""
_SAME_SPEED: Final = 0.03
"""Two ends less apart than this read each other without error; beyond, bits are sampled."""

_NAV_PVT: Final = struct.Struct("<IHBBBBBBIiBBBBiiiiIIiiiiiIIH6xihH")
_POSLLH: Final = struct.Struct("<IiiiiII")
_SOL: Final = struct.Struct("<IihBBiiiIiiiIHBBI")
_VELNED: Final = struct.Struct("<IiiiIIiII")
_TIMEUTC: Final = struct.Struct("<IIiHBBBBBB")
_ACK_ACK, _ACK_NAK = 0x01, 0x00
_CFG_PRT, _CFG_MSG, _CFG_RATE, _CFG_NAV5, _CFG_VALSET = 0x00, 0x01, 0x08, 0x24, 0x8A
_PVT: Final = 0x07
_OLD_MESSAGES: Final = (0x02, 0x06, 0x12, 0x21)
"""POSLLH, SOL, VELNED, TIMEUTC, in the order in which a u-blox 6 sends them."""
_KEY_SIZES: Final = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8}
_KEY_BAUD, _KEY_PERIOD, _KEY_PVT, _KEY_NMEA, _KEY_MODEL = (
    0x40520001, 0x30210001, 0x20910007, 0x10740002, 0x20110021,
)  # fmt: skip
_UNIX_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
_GPS_EPOCH_UNIX_US: Final = 315_964_800_000_000
_LEAP_US: Final = 18_000_000
_WEEK_MS: Final = 604_800_000
_FRAME_ERRORS_MAX: Final = 100
"""In one second: then a u-blox stops listening until the second is over."""
_MPS_PER_KNOT: Final = 0.514444


@dataclass(frozen=True, slots=True)
class GpsModule:
    """Properties of a GPS module."""

    hardware: str = ""
    """hwVersion of its UBX-MON-VER; empty if it does not answer that."""
    baud: int = 9600
    """As stored."""
    legacy: bool = False
    """Takes UBX-CFG-PRT and relatives."""
    valset: bool = False
    """Takes UBX-CFG-VALSET."""
    pvt: bool = True
    """Supports UBX-NAV-PVT; a u-blox 6 does not."""
    acknowledges: bool = True
    talkers: tuple[str, ...] = ("GN",)
    """Of the NMEA sentences; every one of them sends GSA, the first one the rest."""
    repeats: bool = False
    """Every talker sends RMC and GGA too."""


GPS_MODULES: Final = {
    "u-blox 6": GpsModule("00040007", legacy=True, pvt=False, talkers=("GP",)),
    "u-blox 7": GpsModule("00070000", legacy=True, talkers=("GP",)),
    "u-blox M8": GpsModule("00080000", legacy=True, talkers=("GN", "GP", "GL")),
    "u-blox 9": GpsModule("00190000", 38400, legacy=True, valset=True),
    "u-blox M10": GpsModule("000A0000", 38400, valset=True),
    "u-blox, no acknowledgement": GpsModule(legacy=True, acknowledges=False),
    "u-blox 6, no acknowledgement": GpsModule(legacy=True, pvt=False, acknowledges=False),
    "NMEA": GpsModule(talkers=("GN", "BD")),
    "NMEA, two receivers": GpsModule(talkers=("GP", "GL"), repeats=True),
}


def ubx(message_class: int, identifier: int, payload: bytes) -> bytes:
    """Build a UBX message."""
    body = bytes([message_class, identifier]) + len(payload).to_bytes(2, "little") + payload
    a = b = 0
    for byte in body:
        a = (a + byte) & 0xFF
        b = (b + a) & 0xFF
    return b"\xb5\x62" + body + bytes([a, b])


def nmea(text: str) -> bytes:
    """Build an NMEA sentence."""
    checksum = 0
    for byte in text.encode():
        checksum ^= byte
    return f"${text}*{checksum:02X}\r\n".encode()


class _Epoch:
    """One solution in the units of the messages."""

    def __init__(self, unix_us: int, fix: Solution) -> None:
        self.fix = fix
        self.utc = _UNIX_EPOCH + timedelta(microseconds=unix_us)
        self.itow_ms = (unix_us - _GPS_EPOCH_UNIX_US + _LEAP_US) // 1000 % _WEEK_MS
        self.nano = self.utc.microsecond * 1000
        self.lon, self.lat = round(fix.lon_deg * 1e7), round(fix.lat_deg * 1e7)
        self.height_mm = round((fix.alt_amsl_m + fix.geoid_separation_m) * 1000)
        self.msl_mm = round(fix.alt_amsl_m * 1000)
        self.h_acc_mm, self.v_acc_mm = round(fix.h_acc_m * 1000), round(fix.v_acc_m * 1000)
        self.speed_acc_mmps = round(fix.speed_acc_mps * 1000)
        self.vel_mmps = tuple(round(v * 1000) for v in fix.vel_n_mps)
        self.course_acc, self.pdop = round(fix.course_acc_deg * 1e5), round(fix.pdop * 100)

    @property
    def clock(self) -> tuple[int, ...]:
        u = self.utc
        return u.year, u.month, u.day, u.hour, u.minute, u.second

    def pvt(self) -> bytes:
        """Build the payload of a UBX-NAV-PVT."""
        fix = self.fix
        speed = round(float(np.hypot(*self.vel_mmps[:2])))
        valid = 0x37 if fix.time_valid else 0x00
        return _NAV_PVT.pack(
            self.itow_ms, *self.clock, valid, 30, self.nano, fix.fix_type, int(fix.fix_ok), 0,
            fix.satellites, self.lon, self.lat, self.height_mm, self.msl_mm, self.h_acc_mm,
            self.v_acc_mm, *self.vel_mmps, speed, 0, self.speed_acc_mmps, self.course_acc,
            self.pdop, 0, 0, 0,
        )  # fmt: skip

    def old(self, identifier: int) -> bytes:
        """Build the payload of one of the messages of a u-blox 6."""
        fix, vel_cmps = self.fix, [round(v / 10) for v in self.vel_mmps]
        speed = round(float(np.hypot(*vel_cmps[:2])))
        match identifier:
            case 0x02:
                place = (self.lon, self.lat, self.height_mm, self.msl_mm)
                return _POSLLH.pack(self.itow_ms, *place, self.h_acc_mm, self.v_acc_mm)
            case 0x06:
                return _SOL.pack(
                    self.itow_ms, 0, 0, fix.fix_type, int(fix.fix_ok), 0, 0, 0, 0, 0, 0, 0, 0,
                    self.pdop, 0, fix.satellites, 0,
                )  # fmt: skip
            case 0x12:
                accuracy = (self.speed_acc_mmps // 10, self.course_acc)
                return _VELNED.pack(self.itow_ms, *vel_cmps, speed, speed, 0, *accuracy)
            case _:
                valid = 0x07 if fix.time_valid else 0x00
                return _TIMEUTC.pack(self.itow_ms, 30, self.nano, *self.clock, valid)

    def nmea(self, module: GpsModule, talker: str, *, short: bool) -> bytes:
        """Build the sentences of one talker."""
        sentences = []
        first = talker == module.talkers[0]
        if first or module.repeats:
            sentences += [self._rmc(talker), self._gga(talker)]
        sentences.append(self._gsa(talker))
        if first and not short:
            satellites = ",".join(f"{k:02d},45,{k * 30:03d},38" for k in range(1, 5))
            sentences += [f"{talker}GSV,3,{k},12,{satellites}" for k in (1, 2, 3)]
            sentences.append(f"{talker}GLL,,,,,,V,N")
        return b"".join(nmea(sentence) for sentence in sentences)

    def _time(self) -> str:
        return f"{self.utc:%H%M%S}.{self.utc.microsecond // 10_000:02d}"

    def _angles(self) -> str:
        lat, lon = abs(self.fix.lat_deg), abs(self.fix.lon_deg)
        north, east = "NS"[self.fix.lat_deg < 0], "EW"[self.fix.lon_deg < 0]
        return (
            f"{int(lat):02d}{lat % 1 * 60:08.5f},{north},{int(lon):03d}{lon % 1 * 60:08.5f},{east}"
        )

    def _rmc(self, talker: str) -> str:
        if not self.fix.fix_ok:
            return f"{talker}RMC,{self._time()},V,,,,,,,{self.utc:%d%m%y},,,N"
        north, east = (v / 1000 for v in self.vel_mmps[:2])
        knots, course = np.hypot(north, east) / _MPS_PER_KNOT, np.degrees(np.arctan2(east, north))
        motion = f"{knots:.3f},{course % 360:.2f}"
        return f"{talker}RMC,{self._time()},A,{self._angles()},{motion},{self.utc:%d%m%y},,,A"

    def _gga(self, talker: str) -> str:
        fix = self.fix
        if not fix.fix_ok:
            return f"{talker}GGA,{self._time()},,,,,0,{fix.satellites:02d},99.99,,,,,,"
        place = f"{self._time()},{self._angles()},1,{min(fix.satellites, 12):02d}"
        heights = f"{fix.alt_amsl_m:.1f},M,{fix.geoid_separation_m:.1f},M"
        return f"{talker}GGA,{place},{fix.pdop / 2:.2f},{heights},,"

    def _gsa(self, talker: str) -> str:
        mode = self.fix.fix_type if self.fix.fix_ok else 1
        dilutions = f"{self.fix.pdop:.2f},{self.fix.pdop / 2:.2f},{self.fix.pdop * 0.8:.2f}"
        return f"{talker}GSA,A,{mode},01,02,03,04,,,,,,,,,{dilutions}"


class Gps:
    """The receiver.

    Parameters
    ----------
    bench : Bench
    world : World
    rng : numpy.random.Generator
    feed : callable
        Starts one byte on the board's receive line, with a framing error or without.
    board_baud : callable
        The speed that the board has set.
    module : GpsModule
    """

    def __init__(
        self,
        bench: Bench,
        world: World,
        rng: np.random.Generator,
        feed: Callable[[int, bool], None],
        board_baud: Callable[[], float],
        module: GpsModule,
        computing_s: float = COMPUTING_S,
    ) -> None:
        self._bench, self._world, self._rng = bench, world, rng
        self._feed, self._board_baud = feed, board_baud
        self.module = module
        self._computing_s = computing_s
        self.absent = False
        self._line_free_ps = self._board_free_ps = 0
        self._generation = 0
        self._to_board = LineSampler(feed)
        self._to_module = LineSampler(self._take)
        self._frame_errors: deque[int] = deque(maxlen=_FRAME_ERRORS_MAX + 1)
        self._deaf_until_ps = self._next_look_ps = 0
        self.reset(module.baud)

    def reset(self, baud: int) -> None:
        """Fall back to stored settings, as when the supply was lost."""
        self.baud = baud
        self.period_s = 1.0
        self.dynamic_model = 0
        self.nmea_on, self.messages_on = True, set[int]()
        self._in = b""
        self._begin_solutions()

    def store_no_messages(self) -> None:
        """Let the stored settings be UBX without any message, as some makers leave them."""
        self.nmea_on = False

    def send_garbage(self, size: int) -> None:
        """Put bytes of noise on the line."""
        self.send(self._rng.integers(0, 256, size).astype(np.uint8).tobytes())

    def send(self, data: bytes, baud: int | None = None) -> None:
        """Put bytes on the line, behind those that wait."""
        if self.absent:
            return
        speed = baud or self.baud
        byte_ps = 10 * PS_PER_S // speed
        at_ps = max(self._bench.now_ps, self._line_free_ps)
        for byte in data:
            self._bench.at(at_ps, partial(self._pass_byte, byte, speed))
            at_ps += byte_ps
        self._line_free_ps = at_ps

    def hear(self, end_ps: int, byte: int) -> None:
        """Take a byte that the board sends, whose stop bit ends at a time."""
        if self.absent:
            return
        baud = self._board_baud()
        if baud and abs(baud / self.baud - 1) < _SAME_SPEED:
            self._take(byte, False)
        elif baud:
            # simavr takes a second byte while the first one is shifted out.
            byte_ps = round(10 * PS_PER_S / baud)
            start_ps = max(end_ps - byte_ps, self._board_free_ps)
            self._board_free_ps = start_ps + byte_ps
            self._to_module.send(start_ps, byte, baud)

    def sample(self) -> None:
        """Sample both lines up to the present time."""
        now_ps = self._bench.now_ps
        self._to_board.receive(now_ps, self._board_baud())
        self._to_module.receive(now_ps, self.baud)
        if now_ps >= self._next_look_ps and (self._to_board.busy or self._to_module.busy):
            self._next_look_ps = now_ps + STEP_PS
            self._bench.at(self._next_look_ps, lambda: None)  # a step ends there

    def _pass_byte(self, byte: int, speed: int) -> None:
        board_baud = self._board_baud()
        if board_baud and abs(board_baud / speed - 1) < _SAME_SPEED:
            self._feed(byte, False)
        else:
            self._to_board.send(self._bench.now_ps, byte, speed)

    def _take(self, byte: int, framing_error: bool) -> None:
        now_ps = self._bench.now_ps
        if framing_error:
            self._frame_errors.append(now_ps)
            first = self._frame_errors[0]
            if len(self._frame_errors) > _FRAME_ERRORS_MAX and now_ps - first < PS_PER_S:
                self._deaf_until_ps = (now_ps // PS_PER_S + 1) * PS_PER_S
                self._frame_errors.clear()
            return
        if now_ps < self._deaf_until_ps:
            return
        self._in = (self._in + bytes([byte]))[-200:]
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
        if ubx(message[2], message[3], message[6:-2]) == message:
            self._handle(message[2], message[3], message[6:-2])

    def _handle(self, message_class: int, identifier: int, payload: bytes) -> None:
        if not (self.module.legacy or self.module.valset):
            return
        if (message_class, identifier) == (0x0A, 0x04) and self.module.hardware:
            extensions = b"PROTVER=18.00".ljust(30, b"\0") * 4
            hardware = self.module.hardware.encode().ljust(10, b"\0")
            self.send(ubx(0x0A, 0x04, b"ROM CORE 3.01".ljust(30, b"\0") + hardware + extensions))
        elif message_class == 0x06:
            before = self.baud
            known = (
                self._set_values(payload)
                if identifier == _CFG_VALSET
                else self.module.legacy and self._configure(identifier, payload)
            )
            if self.module.acknowledges:
                answer = ubx(0x05, _ACK_ACK if known else _ACK_NAK, bytes([0x06, identifier]))
                self.send(answer, before)

    def _configure(self, identifier: int, payload: bytes) -> bool:
        if identifier == _CFG_PRT and len(payload) == 20 and payload[0] == 1:
            self.baud = int.from_bytes(payload[8:12], "little")
            self.nmea_on = bool(int.from_bytes(payload[14:16], "little") & 2)
        elif identifier == _CFG_MSG and len(payload) == 3:
            known = payload[1] == _PVT if self.module.pvt else payload[1] in _OLD_MESSAGES
            if payload[0] != 1 or not (known or payload[1] in _OLD_MESSAGES):
                return False
            (self.messages_on.add if payload[2] else self.messages_on.discard)(payload[1])
        elif identifier == _CFG_RATE and len(payload) == 6:
            self._set_period(int.from_bytes(payload[:2], "little"))
        elif identifier == _CFG_NAV5 and len(payload) == 36 and payload[0] & 1:
            self.dynamic_model = payload[2]
        else:
            return False
        return True

    def _set_values(self, payload: bytes) -> bool:
        """Take a UBX-CFG-VALSET: all of its keys or none."""
        if not self.module.valset or payload[0] != 0 or payload[1] != 1:
            return False
        values, at = dict[int, int](), 4
        while at < len(payload):
            key = int.from_bytes(payload[at : at + 4], "little")
            size = _KEY_SIZES.get(key >> 28 & 7, 0)
            if key not in (_KEY_BAUD, _KEY_PERIOD, _KEY_PVT, _KEY_NMEA, _KEY_MODEL):
                return False
            values[key] = int.from_bytes(payload[at + 4 : at + 4 + size], "little")
            at += 4 + size
        self.baud = values.get(_KEY_BAUD, self.baud)
        self.nmea_on = bool(values.get(_KEY_NMEA, self.nmea_on))
        self.dynamic_model = values.get(_KEY_MODEL, self.dynamic_model)
        if values.get(_KEY_PVT):
            self.messages_on.add(_PVT)
        if _KEY_PERIOD in values:
            self._set_period(values[_KEY_PERIOD])
        return True

    def _set_period(self, period_ms: int) -> None:
        self.period_s = period_ms / 1000
        self._begin_solutions()

    def _begin_solutions(self) -> None:
        """Solve from the next whole period on; solutions under way are dropped."""
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
        unix_us = self._world.start_unix_us + round(epoch_s * 1e6)
        epoch = _Epoch(unix_us, self._world.solution(epoch_s))
        if self.nmea_on:
            for talker in self.module.talkers:
                self.send(epoch.nmea(self.module, talker, short=self.baud < 9600))
        for identifier in sorted(self.messages_on):
            payload = epoch.pvt() if identifier == _PVT else epoch.old(identifier)
            self.send(ubx(0x01, identifier, payload))
