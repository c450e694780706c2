"""Bytes of the receiver to raw records on the gateway clock, with counts of all losses.

One `Link` handles one serial line. It joins the frame decoder, the payload codec, one clock
tracker for the receiver and one for each node, and counts everything that is lost.
"""

from collections import Counter, deque
from dataclasses import dataclass, field
from itertools import takewhile
from typing import Final

import msgspec

from gateway.gps_time import FIRST_YEAR
from gateway.records import (
    NAN,
    BaroRaw,
    GpsFix,
    ImuRaw,
    LinkReport,
    NodeId,
    NodeLink,
    NodeStatus,
    RadioSignal,
    RawRecord,
    ReceiverStatus,
)
from gateway.units import M_PER_CM, M_PER_MM, US_PER_S
from gateway.wire import payloads
from gateway.wire.framing import Fault, FrameDecoder
from gateway.wire.payloads import chip_names
from gateway.wire.timesync import WRAP_US, ClockTracker

UINT16_MAX: Final = 65_535

FRAME_SEQ_MASK: Final = 0xFF
SEQUENCE_MODULUS: Final = 1 << 16
LATE_WINDOW: Final = 64
"""Sequence numbers of late payloads; older ones than any retry queue has are of another run."""
ALL_SEEN: Final = (1 << LATE_WINDOW) - 1
SLOWED: Final = 64
"""Divisor of the elapsed time: the maximum by which a sample's interval may be shortened."""
MOST_AHEAD_US: Final = 50_000
"""A larger correction of the clock estimate is applied at once."""
MAX_PACKETS: Final = 64
"""Maximum waiting packets: more than in a chunk of the line, or than a slow radio sends in 1 s."""
MAX_ARRIVALS: Final = 2048
"""Twice the payloads that a node sends in a second at the radio's maximum rate."""


class SequenceCounter:
    """Distinguish new payloads from duplicates and late ones, and count the gaps."""

    def __init__(self) -> None:
        self.received = 0
        self.lost = 0
        self.duplicates = 0
        self.reordered = 0
        self.has_begun_again = False
        """Whether the numbers have gone back since the last reset."""
        self._last: int | None = None
        self._seen = 0

    def reset(self) -> None:
        """Begin a new sequence after a restart of the sender; the counts stay."""
        self._last = None
        self.has_begun_again = False

    def count(self, seq: int) -> bool:
        """Count one sequence number, modulo 65536; return whether it is neither old nor late."""
        if self._last is None:
            return self._begin(seq)
        ahead = (seq - self._last) % SEQUENCE_MODULUS
        if 0 < ahead < SEQUENCE_MODULUS // 2:
            self._last = seq
            self._seen = (self._seen << ahead | 1) & ALL_SEEN
            self.lost += ahead - 1
            self.received += 1
            return True
        behind = -ahead % SEQUENCE_MODULUS
        if behind >= LATE_WINDOW:
            self.has_begun_again = True
            return self._begin(seq)
        if self._seen >> behind & 1:
            self.duplicates += 1
            return False
        self._seen |= 1 << behind
        self.reordered += 1
        self.received += 1
        self.lost -= 1
        return False

    def _begin(self, seq: int) -> bool:
        self._last = seq
        # Numbers before the first received one do not count as late payloads of this run.
        self._seen = ALL_SEEN
        self.received += 1
        return True


class Arrivals:
    """Times of the newest payloads or records of one sender."""

    def __init__(self) -> None:
        self.times_us: deque[int] = deque(maxlen=MAX_ARRIVALS)

    def rate_hz(self, now_us: int) -> float:
        """Return their number in the last second."""
        recent = takewhile(lambda us: us > now_us - US_PER_S, reversed(self.times_us))
        return float(sum(1 for _ in recent))


@dataclass(slots=True)
class _Node:
    clock: ClockTracker = field(default_factory=ClockTracker)
    restarts: int = 0
    """Restarts of its clock that were processed."""
    sequence: SequenceCounter = field(default_factory=SequenceCounter)
    pipe: int = 0
    signal: RadioSignal | None = None
    last_time_us: int = 0
    last_stamp_us: int | None = None
    """Newest time on the node's clock; None before the first payload after its start."""
    quality: payloads.GpsQualityPayload | None = None
    faults: Counter[str] = field(default_factory=Counter)
    arrivals: Arrivals = field(default_factory=Arrivals)

    def begin_run(self) -> None:
        """Begin a new sequence if the clock has restarted and was not only halted."""
        if self.clock.restarts == self.restarts and self.sequence.has_begun_again:
            self.clock.restarts += 1
        if self.clock.restarts != self.restarts:
            self.restarts = self.clock.restarts
            self.sequence.reset()
            self.last_stamp_us = None


class Link:
    """Decode one receiver's serial line."""

    def __init__(self) -> None:
        self._decoder = FrameDecoder()
        self._receiver_clock = ClockTracker()
        self._receiver_status: ReceiverStatus | None = None
        self._nodes: dict[NodeId, _Node] = {}
        self._unproven: dict[NodeId, tuple[_Node, RawRecord | None]] = {}
        """Nodes with a single payload so far, and its record: noise may look like a payload."""
        self._faults: Counter[str] = Counter()
        self._bytes_received = 0
        self._frames = 0
        self._frames_lost = 0
        self._foreign = 0
        self.packets: deque[payloads.ForeignFrame] = deque(maxlen=MAX_PACKETS)
        """Packets of other programs that the caller has not processed yet."""
        self._next_frame_seq: int | None = None

    def feed(self, data: bytes, arrival_us: int) -> list[RawRecord]:
        """Decode any chunk, read at a time of the gateway clock, and return its records.

        They are in the order of their arrival, without duplicates; the times of one node's IMU
        records strictly grow. Never raises on data: faults are counted.
        """
        self._bytes_received += len(data)
        records: list[RawRecord] = []
        clock = self._receiver_clock
        for event in self._decoder.feed(data):
            frame = event if isinstance(event, Fault) else payloads.decode_content(event)
            if isinstance(frame, Fault):
                self._faults[frame.kind] += 1
                continue
            restarts = clock.restarts
            received_us = clock.observe(frame.receiver_time_us, arrival_us)
            # After a restart of the receiver nothing is known to be missing.
            if self._next_frame_seq is not None and clock.restarts == restarts:
                self._frames_lost += frame.frame_seq - self._next_frame_seq & FRAME_SEQ_MASK
            self._next_frame_seq = frame.frame_seq + 1 & FRAME_SEQ_MASK
            self._frames += 1
            if isinstance(frame, payloads.ReceiverStatusFrame):
                fields = msgspec.structs.asdict(frame)
                del fields["frame_seq"]
                self._receiver_status = ReceiverStatus(time_us=received_us, **fields)
            elif isinstance(frame, payloads.ForeignFrame):
                self._foreign += 1
                self.packets.append(frame)
            elif (node := self._nodes.get(frame.header.node)) is None:
                records += self._receive_new_node(frame, received_us, arrival_us)
            elif (record := _receive(node, frame, received_us, arrival_us)) is not None:
                records.append(record)
        return records

    def reopened(self) -> None:
        """Discard the incomplete frame and the frame sequence after the port was opened again."""
        self._decoder.reset()
        self._next_frame_seq = None

    def report(self, now_us: int, *, connected: bool, port: str) -> LinkReport:
        """Sum up the line and every node behind it."""
        nodes = [*self._nodes.values(), *(node for node, _ in self._unproven.values())]
        faults = sum((node.faults for node in nodes), self._faults)
        return LinkReport(
            time_us=now_us,
            connected=connected,
            port=port,
            bytes_received=self._bytes_received,
            frames=self._frames,
            frames_lost=self._frames_lost,
            faults=tuple(sorted(faults.items())),
            nodes=tuple(_node_link(node_id, n, now_us) for node_id, n in self._nodes.items()),
            receiver=self._receiver_status,
            foreign=self._foreign,
        )

    def _receive_new_node(
        self, frame: payloads.RadioFrame, received_us: int, arrival_us: int
    ) -> list[RawRecord]:
        """Return a payload's records; a node is accepted from the second one that agrees."""
        header = frame.header
        node, first = self._unproven.pop(header.node, (_Node(), None))
        second = _receive(node, frame, received_us, arrival_us)
        if node.clock.restarts:
            # Their node times do not agree with their arrivals: one of the two is wrong.
            node = _Node()
            first, second = None, _receive(node, frame, received_us, arrival_us)
        elif node.sequence.received > 1:
            self._nodes[header.node] = node
            return [record for record in (first, second) if record is not None]
        self._unproven[header.node] = node, first or second
        return []


def _receive(
    node: _Node, frame: payloads.RadioFrame, received_us: int, arrival_us: int
) -> RawRecord | None:
    """Count a payload of a node, and return its record if it is new."""
    header, payload, clock = frame.header, frame.payload, node.clock
    stamp_us, runs = header.node_time_us, clock.runs
    time_us = clock.observe(stamp_us, received_us)
    if clock.runs != runs:
        node.begin_run()
    # A late payload is counted but not used: all later stages rely on growing times.
    if not node.sequence.count(header.seq):
        # A payload newer than the newest must have a higher number.
        last_us = stamp_us if node.last_stamp_us is None else node.last_stamp_us
        node.faults["sequence"] += 0 < (stamp_us - last_us) % WRAP_US < WRAP_US // 2
        return None
    node.pipe, node.signal = frame.pipe, frame.signal
    node.arrivals.times_us.append(arrival_us)
    node.last_time_us = time_us = _never_back(node, stamp_us, time_us)
    node.last_stamp_us = stamp_us
    if not isinstance(payload, payloads.ImuPayload):
        return _to_record(header, payload, node)
    return ImuRaw(
        time_us,
        header.node,
        stamp_us,
        payload.accel,
        payload.gyro,
        payload.mag,
        payload.temperature,
        payloads.ACCEL_RANGES_G[payload.accel_range],
        payloads.GYRO_RANGES_DPS[payload.gyro_range],
        payloads.MAG_LSB_PER_GAUSS[payload.mag_gain],
        payload.flags,
    )


def _never_back(node: _Node, stamp_us: int, time_us: int) -> int:
    """Return the time of a sample if a better estimate of the clock may have set it back.

    The sample then follows the last one a little sooner than the node's clock shows, until the
    times agree: an estimator must not get many samples of one time, nor a stream send them all.
    """
    last_us = node.last_time_us
    if node.last_stamp_us is not None:
        elapsed_us = (stamp_us - node.last_stamp_us) % WRAP_US
        slowed_us = last_us + elapsed_us - elapsed_us // SLOWED
        if time_us < slowed_us <= time_us + MOST_AHEAD_US:
            return slowed_us
    return time_us if time_us > last_us else last_us + 1


def _to_record(
    header: payloads.Header,
    payload: payloads.BaroPayload
    | payloads.GpsFixPayload
    | payloads.GpsQualityPayload
    | payloads.NodeStatusPayload,
    node: _Node,
) -> RawRecord | None:
    stamps = (node.last_time_us, header.node, header.node_time_us)
    match payload:
        case payloads.BaroPayload():
            pressure_pa, degc = payload.pressure_centipa * 1e-2, payload.temperature_ddegc * 1e-1
            return BaroRaw(*stamps, pressure_pa, degc)
        case payloads.GpsFixPayload():
            return _gps_fix(stamps, payload, node.quality)
        case payloads.GpsQualityPayload():
            node.quality = payload
            node.faults["gps_date"] += payload.utc is not None and payload.utc.year < FIRST_YEAR
            return None
        case payloads.NodeStatusPayload():
            # The fields have the same names, except for the chips.
            fields = msgspec.structs.asdict(payload)
            chips = chip_names(fields.pop("chips"), payload.sensors_present)
            return NodeStatus(*stamps, chips=chips, **fields)


def _gps_fix(
    stamps: tuple[int, NodeId, int],
    fix: payloads.GpsFixPayload,
    quality: payloads.GpsQualityPayload | None,
) -> GpsFix:
    north, east, down = fix.vel_n_cmps
    alt_amsl_m = fix.alt_amsl_mm * M_PER_MM
    separation_m = NAN if quality is None else quality.geoid_separation_cm * M_PER_CM
    # The accuracy of another epoch is not that of this fix; the geoid height stays valid.
    if quality is None or quality.itow_ms != fix.itow_ms:
        quality = payloads.GpsQualityPayload(fix.itow_ms, *(UINT16_MAX,) * 5, 0, None)
    utc_us = None
    if quality.utc is not None and quality.utc.year >= FIRST_YEAR:
        utc_us = round(quality.utc.timestamp() * US_PER_S)
    return GpsFix(
        *stamps,
        itow_ms=fix.itow_ms,
        fix_type=fix.fix_type,
        fix_ok=fix.fix_ok,
        satellites=fix.satellites,
        lat_dege7=fix.lat_dege7,
        lon_dege7=fix.lon_dege7,
        alt_amsl_m=alt_amsl_m,
        vel_n_mps=(north * M_PER_CM, east * M_PER_CM, down * M_PER_CM),
        alt_ellipsoid_m=alt_amsl_m + separation_m,
        h_acc_m=_unless_saturated(quality.h_acc_cm, M_PER_CM),
        v_acc_m=_unless_saturated(quality.v_acc_cm, M_PER_CM),
        speed_acc_mps=_unless_saturated(quality.speed_acc_cmps, M_PER_CM),
        course_acc_deg=_unless_saturated(quality.course_acc_cdeg, 1e-2),
        pdop=_unless_saturated(quality.pdop_centi, 1e-2),
        utc_us=utc_us,
    )


def _unless_saturated(value: float, scale: float) -> float:
    """Scale a 16-bit value; NaN for a saturated one, which means only "bad"."""
    return NAN if value == UINT16_MAX else value * scale


def _node_link(node_id: NodeId, node: _Node, now_us: int) -> NodeLink:
    counter = node.sequence
    return NodeLink(
        node=node_id,
        pipe=node.pipe,
        received=counter.received,
        lost=counter.lost,
        duplicates=counter.duplicates,
        reordered=counter.reordered,
        restarts=node.clock.restarts,
        rate_hz=node.arrivals.rate_hz(now_us),
        last_time_us=node.arrivals.times_us[-1],
        clock_skew_ppm=node.clock.skew_ppm,
        signal=node.signal,
    )
