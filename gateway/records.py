"""The frozen records that the stages exchange.

Names follow the rule quantity, frame, unit. Body frame `_b` is FRD (x forward, y right, z down);
navigation frame `_n` is NED. Times are integers in microseconds: `time_us` on the gateway clock
(monotonic, zero when the daemon starts), `node_time_us` on a node's own clock. An unknown float is
NaN; a record that does not exist yet is None.

They are msgspec structs: these are created for every sample, cost an eighth of a frozen dataclass,
and are not tracked by the garbage collector. `msgspec.structs.replace` copies one with changes.
"""

from enum import IntEnum, IntFlag
from typing import Annotated, Final

import msgspec

Vec3 = tuple[float, float, float]
Int3 = tuple[int, int, int]
Quat = tuple[float, float, float, float]

NAN = float("nan")
UNKNOWN_QUAT: Quat = (NAN, NAN, NAN, NAN)
UNKNOWN_VEC3: Vec3 = (NAN, NAN, NAN)

RECORDED_ONLY = -1
"""Client id of an outgoing frame that is only written to the recording."""
NODE_IMU: Final = 1 << 0
NODE_GPS: Final = 1 << 3
"""Bits of `NodeStatus.sensors_present`."""
LORA_CHANNEL: Final = 0xFF
SOURCE_NODE: Final = 8
"""Node id of a vehicle's first source other than the receiver; boards have 0 to 7."""
START_V2: Final = 0xFD
PAYLOAD_V1: Final = 6
PAYLOAD_V2: Final = 10
"""Offset of the payload in a MAVLink 2 frame."""
EVERYBODY: Final = (0, 0)
"""Target of a message without one."""
HEARTBEAT_TYPE_OFFSET: Final = 4
_TYPE_GCS: Final = bytes((6,))
"""MAV_TYPE_GCS as a byte."""
_TYPE_TRACKER: Final = bytes((5,))
"""MAV_TYPE_ANTENNA_TRACKER as a byte."""
_NO_AUTOPILOT: Final = bytes((8,))
"""MAV_AUTOPILOT_INVALID as a byte."""
TXBUF_OFFSET: Final = 6
"""Offset in RADIO_STATUS, after its two counters and the two signal strengths."""


class ImuFlags(IntFlag):
    """State of an IMU node, one bit each; the first eight are those of the radio payload."""

    ACCEL_FILTERED = 1 << 0
    """The node has low-pass filtered the acceleration; the gateway must not do it again."""
    GYRO_FILTERED = 1 << 1
    """The node has high-pass filtered the angular rate; the gateway must not do it again."""
    MAG_NEW = 1 << 2
    """The magnetometer values are new since the previous IMU payload."""
    MAG_ABSENT = 1 << 3
    BARO_ABSENT = 1 << 4
    SELF_TEST_FAILED = 1 << 5
    ACCEL_CLIPPED = 1 << 6
    GYRO_CLIPPED = 1 << 7
    MAG_UNCALIBRATED = 1 << 8
    """Set by the gateway: the compass has no calibration, so hard and soft iron are not removed."""
    GYRO_UNCALIBRATED = 1 << 9
    ACCEL_UNCALIBRATED = 1 << 10
    """Set by the gateway: the bias of the sensor is not removed."""
    MEANS = 1 << 11
    """Set by the gateway: rate and force are means since the last sample, as nodes send them."""

    __and__ = int.__and__  # type: ignore[assignment]
    """Return a plain int, to test a bit: creating a flag would take six times as long."""


class GpsFixType(IntEnum):
    """Fix types of UBX-NAV-PVT."""

    NONE = 0
    DEAD_RECKONING = 1
    FIX_2D = 2
    FIX_3D = 3
    GNSS_AND_DEAD_RECKONING = 4
    TIME_ONLY = 5


class NavFlags(IntFlag):
    """State of an estimator, and validity of its outputs."""

    ATTITUDE_VALID = 1 << 0
    """Roll and pitch have converged."""
    HEADING_VALID = 1 << 1
    """Yaw refers to true north (magnetometer or GPS course)."""
    POSITION_VALID = 1 << 2
    VELOCITY_VALID = 1 << 3
    ALTITUDE_VALID = 1 << 4
    AT_REST = 1 << 5
    """At rest; the gyroscope bias is being estimated."""
    USING_GPS = 1 << 6
    USING_MAG = 1 << 7
    USING_BARO = 1 << 8
    MAG_DISTURBED = 1 << 9
    GPS_REJECTED = 1 << 10
    """The newest fixes failed the innovation check, and were not used."""
    DEAD_RECKONING = 1 << 11
    """Position and velocity are from inertial data only, because the last fix is old."""
    SENSOR_FAULT = 1 << 12
    """A sensor is stuck, saturated or not finite, and was not used."""
    DEGRADED = 1 << 13
    """At least one output is less accurate than in normal operation."""
    MAG_MISPLACED = 1 << 14
    """The field rotates differently from the aircraft, because axes of the compass are swapped or
    reversed; the compass is not used."""

    __and__ = int.__and__  # type: ignore[assignment]
    """See `ImuFlags`."""


class NodeId(msgspec.Struct, frozen=True, gc=False):
    """The node and the aircraft of a payload."""

    vehicle_id: int
    """1 to 31; it is the MAVLink system id unless the settings state another one."""
    node_id: int
    """0 to 7, unique within the aircraft."""


class ImuRaw(msgspec.Struct, frozen=True, gc=False):
    """One IMU payload on the gateway clock, in sensor counts and sensor axes."""

    time_us: int
    node: NodeId
    node_time_us: int
    accel_raw: Int3
    gyro_raw: Int3
    mag_raw: Int3
    temperature_raw: int
    accel_range_g: int
    gyro_range_dps: int
    mag_lsb_per_gauss: int
    flags: ImuFlags


class ImuCalibrated(msgspec.Struct, frozen=True, gc=False):
    """One IMU sample in SI and body FRD without counts, as in other programs' logs."""

    time_us: int
    node: NodeId
    accel_b_mps2: Vec3
    gyro_b_radps: Vec3
    mag_b_ut: Vec3 | None
    """Magnetic field; None unless it is a new sample."""
    temperature_degc: float
    flags: ImuFlags


class BaroRaw(msgspec.Struct, frozen=True, gc=False):
    """One barometer payload on the gateway clock; the node has applied the BMP180's calibration."""

    time_us: int
    node: NodeId
    node_time_us: int
    pressure_pa: float
    temperature_degc: float


class GpsFix(msgspec.Struct, frozen=True, gc=False):
    """One GPS fix at its arrival on the gateway clock; it was valid earlier by the latency."""

    time_us: int
    node: NodeId
    node_time_us: int
    itow_ms: int
    fix_type: GpsFixType
    fix_ok: bool
    """The receiver's gnssFixOK: the fix is within its accuracy masks."""
    satellites: int
    lat_dege7: int
    lon_dege7: int
    alt_amsl_m: float
    vel_n_mps: Vec3 = UNKNOWN_VEC3
    alt_ellipsoid_m: float = NAN
    """NaN until a quality payload has contained the geoid separation."""
    h_acc_m: float = NAN
    v_acc_m: float = NAN
    speed_acc_mps: float = NAN
    course_acc_deg: float = NAN
    pdop: float = NAN
    utc_us: int | None = None
    """Unix time of the fix; None while the receiver reports date or time as invalid."""


class RadioState(IntEnum):
    """State of the radio module of a board."""

    OK = 0
    ABSENT = 1
    LOSES_SETTINGS = 2
    """The module does not keep its configuration."""
    ACTIVATED = 3
    """The module works, but required ACTIVATE, so it is not an nRF24L01+."""

    @property
    def problem(self) -> str:
        """Description of the fault; empty if there is none."""
        if self is RadioState.ABSENT:
            return "radio module does not answer"
        loses = self is RadioState.LOSES_SETTINGS
        return "radio module does not keep its configuration" if loses else ""


def node_role(sensors_present: int) -> str:
    """Return a node's role, from its sensors."""
    if sensors_present & NODE_IMU:
        return "IMU node"
    return "GPS node" if sensors_present & NODE_GPS else "Node"


def board_name(node: NodeId, sensors_present: int = 0) -> str:
    """Return a board's name: aircraft and sensors, `1 IMU`; before its report `1.0`."""
    role = node_role(sensors_present).removesuffix(" node")
    return f"{node.vehicle_id}.{node.node_id}" if role == "Node" else f"{node.vehicle_id} {role}"


class NodeStatus(msgspec.Struct, frozen=True, gc=False):
    """A node's report on itself, sent once a second."""

    time_us: int
    node: NodeId
    node_time_us: int
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
    chips: tuple[str, ...] = ()
    """Names of the chips detected since its start."""


class PipeCounters(msgspec.Struct, frozen=True, gc=False):
    """Counts of the receiver since its start for one of its six radio pipes."""

    received: int
    lost: int
    overruns: int


def channel_name(channel: int) -> str:
    """Return the name of the channel in a receiver's report."""
    return "LoRa" if channel == LORA_CHANNEL else f"channel {channel}"


class ReceiverStatus(msgspec.Struct, frozen=True, gc=False):
    """The receiver's report on itself, sent once a second."""

    time_us: int
    receiver_time_us: int
    channel: int
    """Channel of an nRF24L01+, 2400 MHz plus this; `LORA_CHANNEL` for a LoRa radio."""
    noise_percent: int
    """Share of idle time in which the channel had a carrier above -64 dBm (LoRa: -100 dBm)."""
    uart_dropped: int
    reset_cause: int
    pipes: tuple[PipeCounters, ...]
    radio: RadioState = RadioState.OK


RawRecord = ImuRaw | BaroRaw | GpsFix | NodeStatus


class ImuSample(msgspec.Struct, frozen=True, gc=False):
    """One calibrated IMU sample in body FRD."""

    time_us: int
    accel_b_mps2: Vec3
    """Specific force, calibrated, in the node's bandwidth; (0, 0, -9.81) when level at rest."""
    gyro_b_radps: Vec3
    mag_b_ut: Vec3 | None
    """Calibrated magnetic field; None unless it is a new sample."""
    temperature_degc: float
    flags: ImuFlags


class BaroSample(msgspec.Struct, frozen=True, gc=False):
    """One calibrated barometer sample."""

    time_us: int
    pressure_pa: float
    temperature_degc: float
    alt_pressure_m: float
    """Height in the ICAO standard atmosphere, positive up."""


class NavState(msgspec.Struct, frozen=True, gc=False):
    """The estimate at the time of one IMU sample; unknown values are NaN."""

    time_us: int
    q_nb: Quat
    """Attitude, body FRD to NED, scalar first, unit norm."""
    rate_b_radps: Vec3
    """Angular rate, bias removed."""
    lat_deg: float
    lon_deg: float
    alt_amsl_m: float
    vel_n_mps: Vec3
    attitude_std_rad: Vec3
    """Standard deviations about north, east and down."""
    vel_std_mps: Vec3
    pos_std_m: Vec3
    """Standard deviations north, east, down."""
    flags: NavFlags


class FusedSample(msgspec.Struct, frozen=True, gc=False):
    """One IMU sample and the resulting state.

    Together with the `BaroRaw` and `GpsFix` records in between, in their order, these are all data
    that a recording requires to be fused again bit for bit.
    """

    vehicle_id: int
    imu: ImuRaw | None
    """None if the source has no counts."""
    sample: ImuSample
    state: NavState


class FusionState(msgspec.Struct, frozen=True, gc=False):
    """The state of one aircraft between two samples, with which fusion continues exactly."""

    vehicle_id: Annotated[int, msgspec.Meta(ge=1, le=255)]
    fits: str
    """Checksum of the version and the settings with which it can be restored."""
    estimation: bytes
    """State in a format private to the stage that writes it."""
    home: tuple[float, float, float, int] | None = None
    """Latitude and longitude in degrees, height in m AMSL, time of setting on the gateway clock."""


class RadioSignal(msgspec.Struct, frozen=True, gc=False):
    """Signal of a received packet, from a radio that measures it."""

    rssi_dbm: int
    snr_db: float


class BatteryReport(msgspec.Struct, frozen=True, gc=False, kw_only=True):
    """A battery as reported by an autopilot or a tracker; unknown values are NaN."""

    number: int = 0
    voltage_v: float = NAN
    current_a: float = NAN
    used_mah: float = NAN
    remaining_percent: float = NAN
    cells_v: tuple[float, ...] = ()


class VehicleReport(msgspec.Struct, frozen=True, gc=False, kw_only=True):
    """Part of a vehicle's state as reported by its own autopilot: passed on, never fused.

    A report contains some of the fields; the others are NaN, None or empty, and do not change the
    values of earlier reports.
    """

    time_us: int
    node: NodeId
    attitude_rad: Vec3 | None = None
    """Roll, pitch and yaw; yaw is from true north, as far as the autopilot can determine it."""
    heading_rad: float = NAN
    """Heading, used if roll and pitch are unknown."""
    climb_mps: float = NAN
    airspeed_mps: float = NAN
    alt_home_m: float = NAN
    """Height above home."""
    throttle_percent: float = NAN
    home: tuple[float, float, float] | None = None
    """Latitude and longitude in degrees, height in m AMSL."""
    battery: BatteryReport | None = None
    mode: str = ""
    custom_mode: int | None = None
    """Number of the mode in ArduPilot's numbering, which ground stations use to name it."""
    armed: bool | None = None
    vehicle_type: int | None = None
    """A MAV_TYPE."""
    text: tuple[int, str] | None = None
    """MAV_SEVERITY and text of an event."""
    link_quality_percent: float = NAN
    signal: "RadioSignal | None" = None
    channels_us: tuple[int, ...] = ()
    """Pulse widths of the remote control's channels."""
    values: tuple[tuple[str, float], ...] = ()
    """Other measurements by name, such as temperatures."""


class NodeLink(msgspec.Struct, frozen=True, gc=False):
    """Counts of the gateway for one node since the gateway's start."""

    node: NodeId
    pipe: int = 0
    received: int = 0
    lost: int = 0
    """Gaps in the node's sequence numbers, minus late payloads."""
    duplicates: int = 0
    reordered: int = 0
    restarts: int = 0
    rate_hz: float = 0.0
    """Payloads per second, measured over the last second."""
    last_time_us: int = 0
    """Time of arrival of the newest payload on the gateway clock."""
    clock_skew_ppm: float = 0.0
    """Clock rate of the node relative to the gateway's; positive if it is faster."""
    signal: RadioSignal | None = None
    """Signal of the newest payload; None from a radio that does not measure it."""


class LinkReport(msgspec.Struct, frozen=True, gc=False):
    """State of the serial link and of all nodes behind it; created once a second."""

    time_us: int
    connected: bool
    port: str
    bytes_received: int
    frames: int
    frames_lost: int
    """Gaps in the receiver's own frame numbers."""
    faults: tuple[tuple[str, int], ...]
    """Kind and number of the faults that have occurred."""
    nodes: tuple[NodeLink, ...]
    receiver: ReceiverStatus | None
    foreign: int = 0
    """Packets of other programs that the receiver passed on."""
    name: str = "Receiver"
    """Name of the device whose connection is reported."""
    sources: "tuple[SourceReport, ...]" = ()


class SourceReport(msgspec.Struct, frozen=True, gc=False):
    """State of a source other than the receiver."""

    url: str
    node: NodeId
    connected: bool
    reason: str
    """Reason why it is not connected; empty if it is."""
    bytes_received: int
    records: int
    faults: tuple[tuple[str, int], ...]
    """Kind and number of the faults that have occurred."""
    newest_fault: str
    last_time_us: int | None
    """Time of the newest record."""
    rate_hz: float = 0.0
    """Records per second, measured over the last second."""


class MavFrame(msgspec.Struct, frozen=True, gc=False):
    """One complete frame with its decoded header; created once, then passed on unchanged."""

    data: bytes
    """The frame, byte for byte."""
    key: bytes
    """System, component and message as header bytes, which identify the kind of frame in a dict."""
    message_id: int
    origin: tuple[int, int]
    """System and component that sent it."""
    target: tuple[int, int]
    """System and component that it addresses; 0 addresses all."""
    sequence: int
    signed: bool

    @property
    def payload(self) -> bytes:
        """The payload as sent: MAVLink 2 truncates trailing zeros."""
        begin = PAYLOAD_V2 if self.data[0] == START_V2 else PAYLOAD_V1
        return self.data[begin : begin + self.data[1]]

    @property
    def is_station_heartbeat(self) -> bool:
        """Whether this HEARTBEAT is from a ground station."""
        return self.payload[HEARTBEAT_TYPE_OFFSET : HEARTBEAT_TYPE_OFFSET + 1] == _TYPE_GCS

    @property
    def is_autopilot_heartbeat(self) -> bool:
        """Whether this HEARTBEAT is from an autopilot, not from a station or a companion."""
        autopilot = self.payload[HEARTBEAT_TYPE_OFFSET + 1 : HEARTBEAT_TYPE_OFFSET + 2]
        return not self.is_station_heartbeat and autopilot != _NO_AUTOPILOT

    @property
    def is_tracker_heartbeat(self) -> bool:
        """Whether this HEARTBEAT is from an antenna tracker."""
        return self.payload[HEARTBEAT_TYPE_OFFSET : HEARTBEAT_TYPE_OFFSET + 1] == _TYPE_TRACKER

    @property
    def free_percent(self) -> int:
        """Free share of the transmit buffer in this RADIO_STATUS, percent."""
        payload = self.payload
        return payload[TXBUF_OFFSET] if len(payload) > TXBUF_OFFSET else 0


class Outgoing(msgspec.Struct, frozen=True, gc=False):
    """One encoded MAVLink frame and its destination."""

    frame: bytes
    message_id: int
    client_id: int | None = None
    """The client that it answers, None for all clients, or `RECORDED_ONLY`."""
    header: MavFrame | None = None
    """The same frame with its decoded header, if the encoder has provided it."""


class ClientInterval(msgspec.Struct, frozen=True, gc=False):
    """A client's requested interval for one message of one system."""

    client_id: int
    system_id: int
    message_id: int
    interval_us: int
    """Minimum time between two frames; 0 for the rate in the settings, -1 to stop the message."""


class Incoming(msgspec.Struct, frozen=True, gc=False):
    """One MAVLink frame received from a client."""

    client_id: int
    frame: bytes
    trusted: bool
    """Whether the settings allow this client to change the state."""
    forwarded: bool = False
    """Whether it is also forwarded to other systems, and recorded there."""


class LoggedRequest(msgspec.Struct, frozen=True, gc=False):
    """Requests of one kind from one sender, with one outcome."""

    vehicle_id: int
    system_id: int
    component_id: int
    request: str
    """Message and its subject, such as `COMMAND_LONG REQUEST_MESSAGE 62`."""
    outcome: str
    """Reason, such as `UNSUPPORTED` or `no answer`."""
    count: int
    time_us: int
    """Time on the gateway clock at which the newest one was received."""
