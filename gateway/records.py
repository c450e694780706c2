"""The frozen records that the stages exchange.

Names follow the rule quantity, frame, unit. Body frame `_b` is FRD (x forward, y right, z down);
navigation frame `_n` is NED. Times are integers in microseconds: `time_us` on the gateway clock
(monotonic, zero when the daemon starts), `node_time_us` on a node's own clock. A float that is not
known is NaN; a whole record that does not exist yet is None.

They are msgspec structs: created for every sample, they cost an eighth of a frozen dataclass, and
are not tracked by the garbage collector. `msgspec.structs.replace` copies one with changes.
"""

from enum import IntEnum, IntFlag
from typing import Annotated, Final

import msgspec

Vec3 = tuple[float, float, float]
Int3 = tuple[int, int, int]
Quat = tuple[float, float, float, float]

NAN = float("nan")
UNKNOWN_VEC3: Vec3 = (NAN, NAN, NAN)

RECORDED_ONLY = -1
"""Client id of an outgoing frame that is written to the recording and sent to nobody."""
NODE_IMU: Final = 1 << 0
NODE_GPS: Final = 1 << 3
"""Bits of `NodeStatus.sensors_present`."""
LORA_CHANNEL: Final = 0xFF
SOURCE_NODE: Final = 8
"""Node id of a vehicle's first source other than the receiver; boards have 0 to 7."""
START_V2: Final = 0xFD
PAYLOAD_V1: Final = 6
PAYLOAD_V2: Final = 10
"""Where the payload of a MAVLink frame begins."""
EVERYBODY: Final = (0, 0)
"""Target of a message without one."""
HEARTBEAT_TYPE_OFFSET: Final = 4
_TYPE_GCS: Final = bytes((6,))
"""MAV_TYPE_GCS."""
_NO_AUTOPILOT: Final = bytes((8,))
"""MAV_AUTOPILOT_INVALID."""
TXBUF_OFFSET: Final = 6
"""Of RADIO_STATUS, behind its two counters and the two signal strengths."""


class ImuFlags(IntFlag):
    """State of an IMU node, one bit each; the first eight are those of the radio payload."""

    ACCEL_FILTERED = 1 << 0
    """The node has low-passed the acceleration; the gateway must not do it again."""
    GYRO_FILTERED = 1 << 1
    """The node has high-passed the angular rate; the gateway must not do it again."""
    MAG_NEW = 1 << 2
    """The magnetometer values were sampled since the previous IMU payload."""
    MAG_ABSENT = 1 << 3
    BARO_ABSENT = 1 << 4
    SELF_TEST_FAILED = 1 << 5
    ACCEL_CLIPPED = 1 << 6
    GYRO_CLIPPED = 1 << 7
    MAG_UNCALIBRATED = 1 << 8
    """Set by the gateway: the compass was never calibrated, hard and soft iron are not removed."""
    GYRO_UNCALIBRATED = 1 << 9
    ACCEL_UNCALIBRATED = 1 << 10
    """Set by the gateway too: a sensor whose bias is not removed."""

    __and__ = int.__and__  # type: ignore[assignment]
    """Returns a plain int to test a bit: building a flag would cost six times as much."""


class GpsFixType(IntEnum):
    """Fix types of UBX-NAV-PVT."""

    NONE = 0
    DEAD_RECKONING = 1
    FIX_2D = 2
    FIX_3D = 3
    GNSS_AND_DEAD_RECKONING = 4
    TIME_ONLY = 5


class NavFlags(IntFlag):
    """State of an estimator, and which of its outputs are valid."""

    ATTITUDE_VALID = 1 << 0
    """Roll and pitch have converged."""
    HEADING_VALID = 1 << 1
    """Yaw refers to true north (magnetometer or GPS course)."""
    POSITION_VALID = 1 << 2
    VELOCITY_VALID = 1 << 3
    ALTITUDE_VALID = 1 << 4
    AT_REST = 1 << 5
    """Rest was detected; gyro bias is being learned."""
    USING_GPS = 1 << 6
    USING_MAG = 1 << 7
    USING_BARO = 1 << 8
    MAG_DISTURBED = 1 << 9
    GPS_REJECTED = 1 << 10
    """The newest fixes failed the innovation check and were not used."""
    DEAD_RECKONING = 1 << 11
    """Position and velocity run on inertial data only, because the last fix is old."""
    SENSOR_FAULT = 1 << 12
    """A sensor is stuck, saturated or not finite, and was left out."""
    DEGRADED = 1 << 13
    """At least one output is worse than the estimator's normal working."""
    MAG_MISPLACED = 1 << 14
    """The field turns otherwise than the aircraft, since axes of the compass are swapped or
    reversed; it is not used."""

    __and__ = int.__and__  # type: ignore[assignment]
    """As in `ImuFlags`."""


class NodeId(msgspec.Struct, frozen=True, gc=False):
    """The node and aircraft that a payload comes from."""

    vehicle_id: int
    """1 to 31; becomes the MAVLink system id unless the settings say otherwise."""
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
    """One IMU sample in SI and body FRD without counts, as from other programs' logs."""

    time_us: int
    node: NodeId
    accel_b_mps2: Vec3
    gyro_b_radps: Vec3
    mag_b_ut: Vec3 | None
    """None unless newly sampled."""
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
    """One GPS fix at its arrival on the gateway clock; it was valid `latency` earlier."""

    time_us: int
    node: NodeId
    node_time_us: int
    itow_ms: int
    fix_type: GpsFixType
    fix_ok: bool
    """The receiver's own gnssFixOK: within its accuracy masks."""
    satellites: int
    lat_dege7: int
    lon_dege7: int
    alt_amsl_m: float
    vel_n_mps: Vec3
    alt_ellipsoid_m: float
    """NaN until a quality payload has given the geoid separation."""
    h_acc_m: float
    v_acc_m: float
    speed_acc_mps: float
    course_acc_deg: float
    pdop: float
    utc_us: int | None
    """Unix time of the fix, or None while the receiver does not report date and time as valid."""


class RadioState(IntEnum):
    """State of the radio module of a board."""

    OK = 0
    ABSENT = 1
    LOSES_SETTINGS = 2
    """It does not keep its configuration."""
    ACTIVATED = 3
    """It works, but needed ACTIVATE: it is no nRF24L01+."""

    @property
    def problem(self) -> str:
        """The fault, for people; empty if it works."""
        match self:
            case RadioState.ABSENT:
                return "radio module does not answer"
            case RadioState.LOSES_SETTINGS:
                return "radio module does not keep its configuration"
            case _:
                return ""


def node_role(sensors_present: int) -> str:
    """Name a node's role by its sensors."""
    if sensors_present & NODE_IMU:
        return "IMU node"
    return "GPS node" if sensors_present & NODE_GPS else "Node"


def board_name(node: NodeId, sensors_present: int = 0) -> str:
    """Name a board by aircraft and sensors, `1 IMU`, or before its report by number: `1.0`."""
    role = node_role(sensors_present).removesuffix(" node")
    return f"{node.vehicle_id}.{node.node_id}" if role == "Node" else f"{node.vehicle_id} {role}"


class NodeStatus(msgspec.Struct, frozen=True, gc=False):
    """A node's own once-a-second report."""

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
    """Names of the chips found since its start; empty from firmware before 1.1."""


class PipeCounters(msgspec.Struct, frozen=True, gc=False):
    """Counts of the receiver on one of its six radio pipes since it started."""

    received: int
    lost: int
    overruns: int


def channel_name(channel: int) -> str:
    """Name the channel of a receiver's report."""
    return "LoRa" if channel == LORA_CHANNEL else f"channel {channel}"


class ReceiverStatus(msgspec.Struct, frozen=True, gc=False):
    """The receiver's own once-a-second report."""

    time_us: int
    receiver_time_us: int
    channel: int
    """Of an nRF24L01+: 2400 MHz plus this; `LORA_CHANNEL` for a LoRa radio."""
    noise_percent: int
    """Share of idle listening in which the channel held a carrier above -64 dBm, or -100 dBm."""
    uart_dropped: int
    reset_cause: int
    pipes: tuple[PipeCounters, ...]
    radio: RadioState = RadioState.OK


RawRecord = ImuRaw | BaroRaw | GpsFix | NodeStatus


class ImuSample(msgspec.Struct, frozen=True, gc=False):
    """One calibrated IMU sample in body FRD."""

    time_us: int
    accel_b_mps2: Vec3
    """Specific force, calibrated, in the node's bandwidth; level at rest (0, 0, -9.81)."""
    gyro_b_radps: Vec3
    mag_b_ut: Vec3 | None
    """Calibrated magnetic field, None unless newly sampled."""
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
    """One IMU sample and the state it led to.

    Together with the `BaroRaw` and `GpsFix` records in between, in their order, it is all that a
    recording needs to be fused again bit for bit.
    """

    vehicle_id: int
    imu: ImuRaw | None
    """None where the source has no counts."""
    sample: ImuSample
    state: NavState


class FusionState(msgspec.Struct, frozen=True, gc=False):
    """The state of one aircraft between two samples that is needed to continue exactly."""

    vehicle_id: Annotated[int, msgspec.Meta(ge=1, le=255)]
    fits: str
    """Checksum of version and settings that it can be restored with."""
    estimation: bytes
    """Private to the stage that writes it."""
    home: tuple[float, float, float, int] | None = None
    """Latitude and longitude in degrees, height in m AMSL, and since when on the gateway clock."""


class RadioSignal(msgspec.Struct, frozen=True, gc=False):
    """How a packet was received, by a radio that measures it."""

    rssi_dbm: int
    snr_db: float


class BatteryReport(msgspec.Struct, frozen=True, gc=False, kw_only=True):
    """A battery as an autopilot or a tracker reports it; unknown values are NaN."""

    number: int = 0
    voltage_v: float = NAN
    current_a: float = NAN
    used_mah: float = NAN
    remaining_percent: float = NAN
    cells_v: tuple[float, ...] = ()


class VehicleReport(msgspec.Struct, frozen=True, gc=False, kw_only=True):
    """Part of a vehicle's state as its own autopilot reports it: passed on, never fused.

    Each report has a few of the fields; the others are NaN, None or empty, and leave as they are
    those that earlier reports have set.
    """

    time_us: int
    node: NodeId
    attitude_rad: Vec3 | None = None
    """Roll, pitch and yaw; yaw is from true north, as far as the autopilot knows it."""
    heading_rad: float = NAN
    """Heading, where roll and pitch are unknown."""
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
    """Number of the mode as ArduPilot counts them, by which ground stations name it."""
    armed: bool | None = None
    vehicle_type: int | None = None
    """A MAV_TYPE."""
    text: tuple[int, str] | None = None
    """MAV_SEVERITY and text of an event."""
    link_quality_percent: float = NAN
    signal: "RadioSignal | None" = None
    channels_us: tuple[int, ...] = ()
    """Pulse widths of the radio control's channels."""
    values: tuple[tuple[str, float], ...] = ()
    """Other measurements by name, such as temperatures."""


class NodeLink(msgspec.Struct, frozen=True, gc=False):
    """Counts of the gateway for one node since it started."""

    node: NodeId
    pipe: int
    received: int
    lost: int
    """Gaps in the node's sequence, less late payloads."""
    duplicates: int
    reordered: int
    restarts: int
    rate_hz: float
    """Payloads per second, over the last second."""
    last_time_us: int
    """Arrival of the newest payload on the gateway clock."""
    clock_skew_ppm: float
    """How much faster than the gateway's the node's clock runs."""
    signal: RadioSignal | None = None
    """Of the newest payload; None from a radio that does not measure it."""


class LinkReport(msgspec.Struct, frozen=True, gc=False):
    """State of the serial link and of every node behind it; built once a second."""

    time_us: int
    connected: bool
    port: str
    bytes_received: int
    frames: int
    frames_lost: int
    """Gaps in the receiver's own frame sequence."""
    faults: tuple[tuple[str, int], ...]
    """Kind and number of faults, only of kinds that occurred."""
    nodes: tuple[NodeLink, ...]
    receiver: ReceiverStatus | None
    foreign: int = 0
    """Packets of other programs that the receiver passed on."""
    name: str = "Receiver"
    """Of that which is connected or not."""
    sources: "tuple[SourceReport, ...]" = ()


class SourceReport(msgspec.Struct, frozen=True, gc=False):
    """State of a source other than the receiver."""

    url: str
    node: NodeId
    connected: bool
    reason: str
    """Why it is not connected; empty if it is."""
    bytes_received: int
    records: int
    faults: tuple[tuple[str, int], ...]
    """Kind and number."""
    newest_fault: str
    last_time_us: int | None
    """Of the newest record."""


class MavFrame(msgspec.Struct, frozen=True, gc=False):
    """One complete frame with its header read; made once, then passed on unchanged."""

    data: bytes
    """The frame, byte for byte."""
    key: bytes
    """System, component and message as header bytes: the kind of frame, as a dictionary key."""
    message_id: int
    origin: tuple[int, int]
    """System and component that sent it."""
    target: tuple[int, int]
    """System and component that it addresses; 0 is everybody."""
    sequence: int
    signed: bool

    @property
    def payload(self) -> bytes:
        """The payload as sent: version 2 cuts trailing zeros off."""
        begin = PAYLOAD_V2 if self.data[0] == START_V2 else PAYLOAD_V1
        return self.data[begin : begin + self.data[1]]

    @property
    def is_station_heartbeat(self) -> bool:
        """Whether this HEARTBEAT reports that its sender is a ground station."""
        return self.payload[HEARTBEAT_TYPE_OFFSET : HEARTBEAT_TYPE_OFFSET + 1] == _TYPE_GCS

    @property
    def is_autopilot_heartbeat(self) -> bool:
        """Whether this HEARTBEAT is an autopilot's, and not a station's or a companion's."""
        autopilot = self.payload[HEARTBEAT_TYPE_OFFSET + 1 : HEARTBEAT_TYPE_OFFSET + 2]
        return not self.is_station_heartbeat and autopilot != _NO_AUTOPILOT

    @property
    def free_percent(self) -> int:
        """Free part of the transmit buffer in this RADIO_STATUS."""
        payload = self.payload
        return payload[TXBUF_OFFSET] if len(payload) > TXBUF_OFFSET else 0


class Outgoing(msgspec.Struct, frozen=True, gc=False):
    """One encoded MAVLink frame and where it goes."""

    frame: bytes
    message_id: int
    client_id: int | None = None
    """The one client it answers, None for every client, or `RECORDED_ONLY`."""
    header: MavFrame | None = None
    """The same frame with its header, if the encoder has provided it."""


class ClientInterval(msgspec.Struct, frozen=True, gc=False):
    """A client's requested rate for one message of one system."""

    client_id: int
    system_id: int
    message_id: int
    interval_us: int
    """Least time between two frames; 0 for the settings' rate, -1 for none at all."""


class Incoming(msgspec.Struct, frozen=True, gc=False):
    """One MAVLink frame that a client sent."""

    client_id: int
    frame: bytes
    trusted: bool
    """Whether the settings let this client change state."""
    forwarded: bool = False
    """Whether it is forwarded to other systems too, and so recorded there."""


class LoggedRequest(msgspec.Struct, frozen=True, gc=False):
    """One kind of request of one sender, with one outcome."""

    vehicle_id: int
    system_id: int
    component_id: int
    request: str
    """Message, and what it is about: `COMMAND_LONG REQUEST_MESSAGE 62`."""
    outcome: str
    """Reason, such as `UNSUPPORTED` or `no answer`."""
    count: int
    time_us: int
    """When the newest was received, on the gateway clock."""
