"""The bytes of radio payloads and receiver frames: `firmware/PROTOCOL.md` in code.

Decoding never raises on data: content that is not a payload of this version becomes a `Fault`.
Encoding is for the simulator, and for the golden vectors that the firmware's tests share.
"""

import struct
from collections.abc import Callable
from datetime import UTC, datetime
from enum import IntEnum
from functools import cache
from typing import Final

import msgspec

from gateway.records import GpsFixType, ImuFlags, NodeId, PipeCounters, RadioSignal, RadioState
from gateway.wire.framing import Fault, FaultKind

GPS_ACKNOWLEDGES: Final = 0x10
"""Bit of the GPS byte: the receiver acknowledges its settings."""
GPS_NMEA: Final = 1
SENSOR_IMU, SENSOR_MAG, SENSOR_BARO, SENSOR_GPS = (1 << bit for bit in range(4))
"""Bits of a node's masks of present and failed sensors."""

_IMU_NAMES: Final = {
    0x68: "MPU6050",
    0x70: "MPU6500",
    0x71: "MPU9250",
    0x73: "MPU9255",
    0x74: "MPU6515",
    0x98: "ICM-20689",
    0x12: "ICM-20602",
    0x19: "MPU6886",
    0xAF: "ICM-20608",
}
"""Names of IMUs by WHO_AM_I."""
_MAG_NAMES: Final = {0x1E: "HMC5883L", 0x0D: "QMC5883L", 0x2C: "QMC5883P"}
"""Names by I2C address; HMC5983 and DA5883 have the identification of the HMC5883L."""
_BARO_NAMES: Final = {
    0x55: "BMP180",
    0x56: "BMP280",
    0x57: "BMP280",
    0x58: "BMP280",
    0x60: "BME280",
}
"""Names of barometers by chip id."""
_GPS_NAMES: Final = {
    GPS_NMEA: "NMEA receiver",
    2: "u-blox look-alike",
    6: "u-blox 6",
    7: "u-blox 7",
    8: "u-blox M8",
    9: "u-blox 9",
    10: "u-blox M10",
}
PROTOCOL_VERSION: Final = 1
MAX_PAYLOAD: Final = 32
"""Bytes of one nRF24L01+ packet."""
PIPES: Final = 6
NO_PIPE: Final = 0xFF
"""Pipe of a frame without a radio payload."""
ACCEL_RANGES_G: Final = (2, 4, 8, 16)
GYRO_RANGES_DPS: Final = (250, 500, 1000, 2000)
HMC5883L_LSB_PER_GAUSS: Final = (1370, 1090, 820, 660, 440, 390, 330, 230)
MAG_LSB_PER_GAUSS: Final = (*HMC5883L_LSB_PER_GAUSS, 3000, 3750)
"""Scale codes: 0 to 7 the HMC5883L's gains, 8 the QMC5883L and 9 the QMC5883P at +-8 G."""
_FRAME_HEADER: Final = struct.Struct("<BBBI")
_HEADER: Final = struct.Struct("<BBHI")
_RADIO_HEAD: Final = struct.Struct("<BBBIBBHI")
"""Header of a frame and of the payload in it."""
_SIGNAL: Final = struct.Struct("<Bb")
_SNR_PER_DB: Final = 4
_unpack_head: Final = _RADIO_HEAD.unpack_from
_IMU: Final = struct.Struct("<3h3h3hhHB")
_BARO: Final = struct.Struct("<Ih")
_GPS_FIX: Final = struct.Struct("<Iiii3hBB")
_GPS_QUALITY: Final = struct.Struct("<IHHHHHhBBBBBBBB")
_NODE_STATUS: Final = struct.Struct("<BBBBBHHHHHHBBBBH")
_RECEIVER_HEAD: Final = struct.Struct("<BBHB")
_PIPE: Final = struct.Struct("<IIH")
_NODES: Final = tuple(NodeId(address >> 3, address & 0x7) for address in range(256))
"""Nodes by the address byte."""
_LEAST_ADDRESS: Final = 1 << 3
"""Least valid address, because no vehicle has the id 0."""
_imu_flags = cache(ImuFlags)
"""Flags are the same for many samples; a lookup costs a tenth of creating them."""
_MAG_SHIFT: Final = 4
_GYRO_SHIFT: Final = 2
_RANGES: Final = tuple(
    (byte & 3, byte >> _GYRO_SHIFT & 3, byte >> _MAG_SHIFT)
    for byte in range(len(MAG_LSB_PER_GAUSS) << _MAG_SHIFT)
)
"""Range codes of accelerometer, gyroscope and magnetometer by their byte; others are faults."""
_RADIO_SHIFT: Final = 4
_RESET_MASK: Final = 0x0F
_RADIO_STATES: Final = frozenset(RadioState)
_Unpack = Callable[[bytes, int], tuple[int, ...]]


class Chips(msgspec.Struct, frozen=True, gc=False):
    """The chips that a node has found, as identified in its report; 0 for none."""

    imu: int = 0
    """WHO_AM_I."""
    magnetometer: int = 0
    """I2C address."""
    barometer: int = 0
    """Chip id."""
    gps: int = 0
    """Kind of receiver, and `GPS_ACKNOWLEDGES`."""
    gps_baud_hundreds: int = 0


def chip_names(chips: Chips, sensors_present: int) -> tuple[str, ...]:
    """Name the chips that a node has found, such as `"QMC5883L"` or `"u-blox M10 at 57600 baud"`.

    An identification of 0 is valid if the bit of the sensor is set.
    """
    names = []
    if sensors_present & SENSOR_IMU:
        names.append(_IMU_NAMES.get(chips.imu, f"MPU6050 look-alike, id 0x{chips.imu:02X}"))
    if sensors_present & SENSOR_MAG:
        names.append(_MAG_NAMES.get(chips.magnetometer, f"compass at 0x{chips.magnetometer:02X}"))
    if sensors_present & SENSOR_BARO:
        names.append(_BARO_NAMES.get(chips.barometer, f"barometer, id 0x{chips.barometer:02X}"))
    if sensors_present & SENSOR_GPS and chips.gps:
        names.append(_gps_name(chips))
    return tuple(names)


def _gps_name(chips: Chips) -> str:
    kind = chips.gps & 0x0F
    name = f"{_GPS_NAMES.get(kind, 'u-blox')} at {100 * chips.gps_baud_hundreds} baud"
    ignores_settings = kind != GPS_NMEA and not chips.gps & GPS_ACKNOWLEDGES
    return f"{name}, acknowledges nothing" if ignores_settings else name


class FrameKind(IntEnum):
    """Kinds of the receiver's frames: low nibble of a frame's first byte."""

    RADIO = 1
    RECEIVER_STATUS = 2
    RADIO_SIGNAL = 3
    """Like `RADIO`, with the signal of the packet."""
    FOREIGN = 4
    """A packet of another program."""


class PayloadKind(IntEnum):
    """Kinds of a node's payloads: low nibble of a payload's first byte."""

    IMU = 1
    BARO = 2
    GPS_FIX = 3
    GPS_QUALITY = 4
    NODE_STATUS = 5


_RADIO_FIRST: Final = PROTOCOL_VERSION << 4 | FrameKind.RADIO


class Header(msgspec.Struct, frozen=True, gc=False):
    """The first bytes of every radio payload."""

    node: NodeId
    seq: int
    """Counts this node's payloads of every kind, modulo 65536."""
    node_time_us: int
    """Time on the node's clock, modulo 2**32: wraps every 71.6 minutes."""


class ImuPayload(msgspec.Struct, frozen=True, gc=False):
    """Counts of IMU and magnetometer, and the codes of their ranges."""

    accel: tuple[int, int, int]
    gyro: tuple[int, int, int]
    mag: tuple[int, int, int]
    temperature: int
    flags: ImuFlags
    accel_range: int
    gyro_range: int
    mag_gain: int


class BaroPayload(msgspec.Struct, frozen=True, gc=False):
    """Barometer reading, compensated on the node."""

    pressure_centipa: int
    temperature_ddegc: int


class GpsFixPayload(msgspec.Struct, frozen=True, gc=False):
    """Position and velocity of one UBX-NAV-PVT."""

    itow_ms: int
    lat_dege7: int
    lon_dege7: int
    alt_amsl_mm: int
    vel_n_cmps: tuple[int, int, int]
    fix_type: GpsFixType
    fix_ok: bool
    satellites: int


class GpsQualityPayload(msgspec.Struct, frozen=True, gc=False):
    """Accuracy and UTC of the fix with the same `itow_ms`; sent before it."""

    itow_ms: int
    h_acc_cm: int
    v_acc_cm: int
    speed_acc_cmps: int
    course_acc_cdeg: int
    pdop_centi: int
    geoid_separation_cm: int
    utc: datetime | None
    """UTC to a hundredth of a second; None unless the receiver reports date and time as valid."""


class NodeStatusPayload(msgspec.Struct, frozen=True, gc=False):
    """A node's once-a-second report."""

    firmware_version: tuple[int, int]
    reset_cause: int
    sensors_present: int
    sensors_failed: int
    bus_errors: int
    radio_failed: int
    radio_retries: int
    loop_max_us: int
    sample_rate_hz: int
    supply_mv: int
    radio: RadioState = RadioState.OK
    chips: Chips = Chips()


Payload = ImuPayload | BaroPayload | GpsFixPayload | GpsQualityPayload | NodeStatusPayload


class RadioFrame(msgspec.Struct, frozen=True, gc=False):
    """One radio payload as the receiver passed it on."""

    frame_seq: int
    pipe: int
    receiver_time_us: int
    header: Header
    payload: Payload
    signal: RadioSignal | None = None
    """None if the radio does not measure it."""


class ForeignFrame(msgspec.Struct, frozen=True, gc=False):
    """A packet of another program, such as RadioHead, as the receiver passed it on."""

    frame_seq: int
    receiver_time_us: int
    signal: RadioSignal
    packet: bytes
    """The packet, with the other program's header."""


class ReceiverStatusFrame(msgspec.Struct, frozen=True, gc=False):
    """The receiver's once-a-second report."""

    frame_seq: int
    receiver_time_us: int
    channel: int
    noise_percent: int
    uart_dropped: int
    reset_cause: int
    pipes: tuple[PipeCounters, ...]
    radio: RadioState = RadioState.OK


def encode_payload(header: Header, payload: Payload) -> bytes:
    """Build the bytes of one radio payload, at most `MAX_PAYLOAD`.

    Raises struct.error if a value does not fit its field.
    """
    kind, body = _encode_body(payload)
    address = header.node.vehicle_id << 3 | header.node.node_id
    first = PROTOCOL_VERSION << 4 | kind
    return _HEADER.pack(first, address, header.seq, header.node_time_us) + body


def encode_radio(
    frame_seq: int,
    pipe: int,
    receiver_time_us: int,
    payload: bytes,
    signal: RadioSignal | None = None,
) -> bytes:
    """Build the content of the serial frame that carries one radio payload."""
    kind = FrameKind.RADIO if signal is None else FrameKind.RADIO_SIGNAL
    head = _FRAME_HEADER.pack(PROTOCOL_VERSION << 4 | kind, frame_seq, pipe, receiver_time_us)
    if signal is not None:
        head += _SIGNAL.pack(-signal.rssi_dbm, round(signal.snr_db * _SNR_PER_DB))
    return head + payload


def encode_receiver_status(status: ReceiverStatusFrame) -> bytes:
    """Build the content of a receiver status frame."""
    first = PROTOCOL_VERSION << 4 | FrameKind.RECEIVER_STATUS
    head = _FRAME_HEADER.pack(first, status.frame_seq, NO_PIPE, status.receiver_time_us)
    cause = status.reset_cause | status.radio << _RADIO_SHIFT
    body = _RECEIVER_HEAD.pack(status.channel, status.noise_percent, status.uart_dropped, cause)
    pipes = b"".join(_PIPE.pack(p.received, p.lost, p.overruns) for p in status.pipes)
    return head + body + pipes


def decode_content(content: bytes) -> RadioFrame | ReceiverStatusFrame | ForeignFrame | Fault:
    """Read the content of one checked serial frame, without COBS and CRC.

    A fault names the invalid part: version, kind, length or a value.
    """
    size = len(content)
    if size < _RADIO_HEAD.size or content[0] != _RADIO_FIRST:
        return _decode_other(content, size)
    _, frame_seq, pipe, receiver_us, first, address, seq, node_us = _unpack_head(content)
    payload = _read_body(first, address, content, _RADIO_HEAD.size)
    if isinstance(payload, FaultKind):
        return Fault(payload, size)
    if pipe >= PIPES:
        return Fault(FaultKind.VALUE, size)
    return RadioFrame(frame_seq, pipe, receiver_us, Header(_NODES[address], seq, node_us), payload)


def _decode_other(
    content: bytes, size: int
) -> RadioFrame | ReceiverStatusFrame | ForeignFrame | Fault:
    """Read a frame without a plain radio payload, or return its fault."""
    if size < _FRAME_HEADER.size:
        return Fault(FaultKind.TOO_SHORT, size)
    first, frame_seq, _, receiver_time_us = _FRAME_HEADER.unpack_from(content)
    if first >> 4 != PROTOCOL_VERSION:
        return Fault(FaultKind.VERSION, size)
    body = content[_FRAME_HEADER.size :]
    match first & 0xF:
        case FrameKind.RADIO:
            return Fault(FaultKind.PAYLOAD, size)
        case FrameKind.RECEIVER_STATUS:
            return _decode_receiver_status(frame_seq, receiver_time_us, body, size)
        case FrameKind.RADIO_SIGNAL | FrameKind.FOREIGN if len(body) <= _SIGNAL.size:
            return Fault(FaultKind.PAYLOAD, size)
        case FrameKind.RADIO_SIGNAL:
            return _decode_radio_signal(content)
        case FrameKind.FOREIGN:
            signal, packet = _split_signal(body)
            return ForeignFrame(frame_seq, receiver_time_us, signal, packet)
    return Fault(FaultKind.KIND, size)


def _decode_radio_signal(content: bytes) -> RadioFrame | Fault:
    """Read a radio payload with its signal: two bytes, then the content of a plain frame."""
    signal, payload = _split_signal(content[_FRAME_HEADER.size :])
    frame = decode_content(bytes([_RADIO_FIRST]) + content[1 : _FRAME_HEADER.size] + payload)
    if isinstance(frame, RadioFrame):
        return msgspec.structs.replace(frame, signal=signal)
    return Fault(frame.kind if isinstance(frame, Fault) else FaultKind.PAYLOAD, len(content))


def _split_signal(body: bytes) -> tuple[RadioSignal, bytes]:
    minus_rssi_dbm, snr = _SIGNAL.unpack_from(body)
    return RadioSignal(-minus_rssi_dbm, snr / _SNR_PER_DB), body[_SIGNAL.size :]


def _read_body(first: int, address: int, data: bytes, begin: int) -> Payload | FaultKind:
    """Read the body of a payload, or return the fault."""
    layout = _BODIES.get((first, len(data) - begin))
    if layout is None or address < _LEAST_ADDRESS:
        return _fault_of(first, address, len(data) - begin)
    unpack, read = layout
    try:
        return read(unpack(data, begin))
    except (ValueError, IndexError):
        return FaultKind.VALUE


def _fault_of(first: int, address: int, body_size: int) -> FaultKind:
    """Return the fault of a payload whose layout or address does not exist."""
    if body_size > MAX_PAYLOAD - _HEADER.size:
        return FaultKind.PAYLOAD
    if first >> 4 != PROTOCOL_VERSION:
        return FaultKind.VERSION
    if address < _LEAST_ADDRESS:
        return FaultKind.VALUE
    return FaultKind.PAYLOAD if first & 0xF in _KINDS else FaultKind.KIND


def _decode_receiver_status(
    frame_seq: int, receiver_time_us: int, body: bytes, size: int
) -> ReceiverStatusFrame | Fault:
    if len(body) != _RECEIVER_HEAD.size + PIPES * _PIPE.size:
        return Fault(FaultKind.PAYLOAD, size)
    channel, noise, dropped, cause = _RECEIVER_HEAD.unpack_from(body)
    radio = cause >> _RADIO_SHIFT
    if noise > 100 or radio not in _RADIO_STATES:
        return Fault(FaultKind.VALUE, size)
    pipes = tuple(PipeCounters(*p) for p in _PIPE.iter_unpack(body[_RECEIVER_HEAD.size :]))
    head = (frame_seq, receiver_time_us, channel, noise, dropped, cause & _RESET_MASK)
    return ReceiverStatusFrame(*head, pipes, RadioState(radio))


def _encode_body(payload: Payload) -> tuple[PayloadKind, bytes]:
    match payload:
        case ImuPayload():
            ranges = payload.accel_range | payload.gyro_range << _GYRO_SHIFT
            ranges |= payload.mag_gain << _MAG_SHIFT
            words = (*payload.accel, *payload.gyro, *payload.mag, payload.temperature)
            return PayloadKind.IMU, _IMU.pack(*words, payload.flags, ranges)
        case BaroPayload():
            body = _BARO.pack(payload.pressure_centipa, payload.temperature_ddegc)
            return PayloadKind.BARO, body
        case GpsFixPayload():
            position = (payload.itow_ms, payload.lat_dege7, payload.lon_dege7, payload.alt_amsl_mm)
            kind = payload.fix_type | payload.fix_ok << 7
            body = _GPS_FIX.pack(*position, *payload.vel_n_cmps, kind, payload.satellites)
            return PayloadKind.GPS_FIX, body
        case GpsQualityPayload():
            return PayloadKind.GPS_QUALITY, _encode_quality(payload)
        case NodeStatusPayload():
            version, cause, *counts, radio, chips = msgspec.structs.astuple(payload)
            values = (*version, cause | radio << _RADIO_SHIFT, *counts)
            body = _NODE_STATUS.pack(*values, *msgspec.structs.astuple(chips))
            return PayloadKind.NODE_STATUS, body


def _encode_quality(payload: GpsQualityPayload) -> bytes:
    utc = payload.utc
    moment = (0,) * 7
    if utc is not None:
        clock = (utc.hour, utc.minute, utc.second, utc.microsecond // 10_000)
        moment = (utc.year - 2000, utc.month, utc.day, *clock)
    # The fields are in the order of the payload.
    *words, _ = msgspec.structs.astuple(payload)
    return _GPS_QUALITY.pack(*words, utc is not None, *moment)


def _read_imu(words: tuple[int, ...]) -> ImuPayload:
    ax, ay, az, gx, gy, gz, mx, my, mz, temperature, flags, ranges = words
    accel, gyro, mag = (ax, ay, az), (gx, gy, gz), (mx, my, mz)
    return ImuPayload(accel, gyro, mag, temperature, _imu_flags(flags), *_RANGES[ranges])


def _read_gps_fix(words: tuple[int, ...]) -> GpsFixPayload:
    itow, lat, lon, alt, north, east, down, kind, satellites = words
    if not (-900_000_000 <= lat <= 900_000_000 and -1_800_000_000 <= lon <= 1_800_000_000):
        raise ValueError("no coordinates of the Earth")
    fix_type, fix_ok = GpsFixType(kind & 0x7F), bool(kind & 0x80)
    return GpsFixPayload(itow, lat, lon, alt, (north, east, down), fix_type, fix_ok, satellites)


def _read_gps_quality(words: tuple[int, ...]) -> GpsQualityPayload:
    valid, year, month, day, hour, minute, second, hundredths = words[7:]
    utc = None
    if valid:
        # A leap second is sent as 60; the last hundredth before it is used instead.
        if second == 60:
            second, hundredths = 59, 99
        clock = (hour, minute, second, hundredths * 10_000)
        utc = datetime(2000 + year, month, day, *clock, tzinfo=UTC)
    itow, h_acc, v_acc, speed_acc, course_acc, pdop, geoid = words[:7]
    return GpsQualityPayload(itow, h_acc, v_acc, speed_acc, course_acc, pdop, geoid, utc)


def _read_node_status(words: tuple[int, ...]) -> NodeStatusPayload:
    major, minor, cause, present, failed, bus, unsent, resent, loop, rate, supply = words[:11]
    counts = (present, failed, bus, unsent, resent, loop, rate, supply)
    states = (RadioState(cause >> _RADIO_SHIFT), Chips(*words[11:]))
    return NodeStatusPayload((major, minor), cause & _RESET_MASK, *counts, *states)


_KINDS: Final = frozenset(PayloadKind)

_Read = Callable[[tuple[int, ...]], Payload]
_BODIES: Final[dict[tuple[int, int], tuple[_Unpack, _Read]]] = {
    (PROTOCOL_VERSION << 4 | kind, layout.size): (layout.unpack_from, read)
    for kind, layout, read in (
        (PayloadKind.IMU, _IMU, _read_imu),
        (PayloadKind.BARO, _BARO, lambda words: BaroPayload(*words)),
        (PayloadKind.GPS_FIX, _GPS_FIX, _read_gps_fix),
        (PayloadKind.GPS_QUALITY, _GPS_QUALITY, _read_gps_quality),
        (PayloadKind.NODE_STATUS, _NODE_STATUS, _read_node_status),
    )
}
"""Decoders by first byte and size of the body."""
