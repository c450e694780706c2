"""Convert the bytes of a source to records, and count all that is dropped.

Theory of operation. A kind of source consists only of a decoder: `feed` takes any chunk of bytes
and its time of arrival, and returns the records and faults in it. There are two kinds of records:
samples of sensors (`ImuRaw`, `BaroRaw`, `GpsFix`), which are calibrated and fused like those of
boards, and reports of an autopilot (`VehicleReport`), which are passed on with their own time. The
`GpsFix` of a vehicle without an IMU is also its position.

Two rules apply to the positions of every kind: latitude and longitude of exactly 0 are no position,
because receivers without one send zeros; and a date before `FIRST_YEAR` is not used, so that the
civil time is that of this machine.
"""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, Final, Protocol, runtime_checkable

from msgspec.structs import replace

from gateway.gps_time import FIRST_YEAR
from gateway.records import (
    BaroRaw,
    GpsFix,
    GpsFixType,
    ImuRaw,
    NodeId,
    NodeLink,
    RadioSignal,
    SourceReport,
    VehicleReport,
)
from gateway.sources.recorded_bytes import TunnelWriter
from gateway.sources.settings import SourceUrl
from gateway.units import US_PER_S
from gateway.wire.framing import Fault
from gateway.wire.link import Arrivals

SourceRecord = ImuRaw | BaroRaw | GpsFix | VehicleReport

MAX_KINDS: Final = 32
"""Maximum number of kinds of faults that are counted by name."""
MAX_DETAIL: Final = 200
SHOWN: Final = 60
"""Characters of an unusable line that are quoted."""
PACKETS: Final = ("udp", "receiver")
"""Transports that preserve message boundaries."""
FIRST_UTC_US: Final = round(datetime(FIRST_YEAR, 1, 1, tzinfo=UTC).timestamp()) * US_PER_S


class SourceDecoder(Protocol):
    """The decoder of one kind of source."""

    def feed(self, data: bytes, arrival_us: int) -> list[SourceRecord | Fault]:
        """Process any chunk, and return the records and faults that it completes; never raises."""
        ...

    def reset(self) -> None:
        """Discard an incomplete frame or line, after the transport was reopened."""
        ...


def unusable(kind: str, line: str, why: str) -> Fault:
    """Return the fault for a line, with the start of the line and the reason."""
    return Fault(kind, len(line), f"{line[:SHOWN]!r}: {why}")


def checked(fix: GpsFix) -> Iterator[SourceRecord | Fault]:
    """Yield a fix without a position at 0/0 and without a date before `FIRST_YEAR`, and its faults.

    Such a position is no fault: it means that there is none.
    """
    if fix.fix_ok and fix.lat_dege7 == fix.lon_dege7 == 0:
        fix = replace(fix, fix_type=GpsFixType.NONE, fix_ok=False)
    if fix.utc_us is not None and fix.utc_us < FIRST_UTC_US:
        fix = replace(fix, utc_us=None)
        why = f"the date of the GPS is before {FIRST_YEAR}: a week rollover, or none received yet"
        yield Fault("gps date", 0, f"{why}; the clock of this machine is used")
    yield fix


class CheckedFrames(ABC):
    """Base of decoders for frames with a checksum.

    The frames have no escaping: the search proceeds byte by byte, and finds the next frame after
    damage, and between bytes of other protocols. Bytes between two frames are one fault.
    """

    HEAD: Final = 3
    """Bytes that are needed to determine the size of a frame."""
    MAX_NOISE: Final = 64
    """Maximum number of bytes without a frame in one fault."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Discard an incomplete frame."""
        self._rest, self._noise = b"", 0

    def feed(self, data: bytes, arrival_us: int) -> list[Any]:
        """Decode every frame that a chunk completes."""
        found: list[Any] = []
        data, at = self._rest + data, 0
        while len(data) - at >= self.HEAD:
            size = self.size_at(data, at)
            if size > len(data) - at:
                break
            if size:
                found += self._end_noise() + self.read(data[at : at + size], arrival_us)
            self._noise += not size
            at += size or 1
        self._rest = data[at:]
        return found if self._noise < self.MAX_NOISE else found + self._end_noise()

    def _end_noise(self) -> list[Any]:
        dropped, self._noise = self._noise, 0
        why = f"{dropped} bytes that belong to no valid frame"
        return [Fault("checksum", dropped, why)] if dropped else []

    @abstractmethod
    def size_at(self, data: bytes, at: int) -> int:
        """Return the size of a frame that begins here, complete or not; 0 if there is none."""

    @abstractmethod
    def read(self, frame: bytes, arrival_us: int) -> list[Any]:
        """Return the records and faults in a frame."""


class TextLines(ABC):
    """Base of decoders for lines of text of a maximum length.

    A datagram or packet ends its last line, with or without a line feed.
    """

    def __init__(self, transport: str, max_line: int) -> None:
        self._max = max_line
        self._end = b"\n" if transport in PACKETS else b""
        self.reset()

    def reset(self) -> None:
        """Discard an incomplete line."""
        self._rest = b""

    def feed(self, data: bytes, arrival_us: int) -> list[SourceRecord | Fault]:
        """Decode every line that a chunk completes."""
        found: list[SourceRecord | Fault] = []
        *lines, rest = (self._rest + data + self._end).split(b"\n")
        for line in lines:
            if len(line) > self._max:
                why = f"a line is longer than {self._max} bytes"
                found.append(Fault("too long", len(line), why))
            elif text := line.decode("utf-8", "replace").strip():
                found += self.line(text, arrival_us)
        if len(rest) > self._max:
            found.append(Fault("too long", len(rest), f"no line ends within {self._max} bytes"))
            rest = b""
        self._rest = rest
        return found

    @abstractmethod
    def line(self, line: str, arrival_us: int) -> list[SourceRecord | Fault]:
        """Return the records and faults in a line, which is not empty."""


@runtime_checkable
class PolledDecoder(SourceDecoder, Protocol):
    """A decoder of HTTP answers that also makes the requests."""

    def request(self) -> str:
        """Return the path and query of the next request."""
        ...


@dataclass(slots=True)
class _Node:
    """Counts of what was received from one vehicle of a source."""

    last_us: int
    received: int = 0
    signal: RadioSignal | None = None
    arrivals: Arrivals = field(default_factory=Arrivals)


class SourceInput:
    """A source: its decoder, and the counts of its records and faults."""

    def __init__(self, url: SourceUrl, node: NodeId, decoder: SourceDecoder) -> None:
        self.url = url
        self.node = node
        self.connected = False
        self.reason = "not opened yet"
        self.decoder = decoder
        self.has_lines = not isinstance(decoder, CheckedFrames)
        """Whether a datagram may be divided at the ends of lines only."""
        self.tunnel = TunnelWriter(node)
        self._bytes = self._records = 0
        self._faults: Counter[str] = Counter()
        self._newest_fault = ""
        self._nodes: dict[NodeId, _Node] = {}

    def feed(
        self, data: bytes, now_us: int, signal: RadioSignal | None = None
    ) -> list[SourceRecord]:
        """Decode bytes that arrived now, with the signal strength if known; count unusable ones."""
        records: list[SourceRecord] = []
        for event in self.events(data, now_us):
            if isinstance(event, Fault):
                continue
            node = self._nodes.setdefault(event.node, _Node(now_us))
            node.received += 1
            node.last_us = now_us
            node.arrivals.times_us.append(now_us)
            if isinstance(event, VehicleReport) and event.signal is not None:
                node.signal = event.signal
            elif signal is not None:
                node.signal = signal
            records.append(event)
        return records

    def events(self, data: bytes, now_us: int) -> Iterator[SourceRecord | Fault]:
        """Decode bytes that arrived now; yield and count the records and faults."""
        self._bytes += len(data)
        for decoded in self.decoder.feed(data, now_us):
            for event in checked(decoded) if isinstance(decoded, GpsFix) else (decoded,):
                if isinstance(event, Fault):
                    self.count(event)
                else:
                    self._records += 1
                yield event

    @property
    def vehicles(self) -> frozenset[int]:
        """The vehicles from which records were received."""
        return frozenset(node.vehicle_id for node in self._nodes)

    def count(self, fault: Fault) -> None:
        """Count a fault."""
        known = fault.kind in self._faults or len(self._faults) < MAX_KINDS
        self._faults[fault.kind if known else "other"] += 1
        self._newest_fault = (fault.detail or fault.kind)[:MAX_DETAIL]

    def opened(self) -> None:
        """Set the state to open, and discard an incomplete line or frame."""
        self.decoder.reset()
        self.connected, self.reason = True, ""

    def lost(self, reason: str) -> None:
        """Set the state to lost, with the reason."""
        self.connected, self.reason = False, reason

    def report(self, now_us: int) -> SourceReport:
        """Return the state of the source for display."""
        return SourceReport(
            self.url.name,
            self.node,
            self.connected,
            self.reason,
            self._bytes,
            self._records,
            tuple(sorted(self._faults.items())),
            self._newest_fault,
            max((node.last_us for node in self._nodes.values()), default=None),
            sum(node.arrivals.rate_hz(now_us) for node in self._nodes.values()),
        )

    def links(self, now_us: int) -> list[NodeLink]:
        """Return the counts as those of nodes, one per vehicle; without numbers none is lost."""
        return [
            NodeLink(
                node=key,
                received=node.received,
                rate_hz=node.arrivals.rate_hz(now_us),
                last_time_us=node.last_us,
                signal=node.signal,
            )
            for key, node in self._nodes.items()
        ]
