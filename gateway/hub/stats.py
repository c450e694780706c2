"""Figures of clients, listening ports and the hub at one moment, and alerts when they get worse.

Every configured client gets its own alerts. The clients of a listening port may be anybody, and any
number: only a few of theirs are passed on in a minute, so that an attack cannot hide other texts.
"""

from dataclasses import dataclass
from typing import Final, NamedTuple

from gateway.units import US_PER_S

WINDOW_US: Final = 60 * US_PER_S
ALERT_AFTER_US: Final = 5 * US_PER_S
"""Shortest announced outage."""
SLOW_FOR_US: Final = 30 * US_PER_S
"""A client that has dropped nothing for this time is no longer slow."""
ALERT_STATES: Final = {
    "unreachable": "unreachable",
    "resolving": "its address is not known",
    "connecting": "not connected",
}
"""Texts used without a reason. `refused` is not among them: a ground station that is not running
is not unusual."""
ALERTS_IN_FULL: Final = 3
"""Maximum alerts of listening ports' clients that are passed on one by one in a minute."""
Key = int | str
"""Id of a client, or URL of a listening port."""


def name_with_remote(name: str, remote: str) -> str:
    """Return the name of a client with the address of its peer."""
    return name if remote in name else f"{name} {remote}"


@dataclass(slots=True)
class ClientCounters:
    """Counters of one client since it appeared."""

    sent: int = 0
    dropped: int = 0
    unheard: int = 0
    """Frames sent to a port without a listener, or withheld from an unproven client."""
    bytes_sent: int = 0
    received: int = 0
    bytes_received: int = 0
    bytes_garbage: int = 0
    cut: int = 0


@dataclass(frozen=True, slots=True)
class ClientStats:
    """One client at one moment, for the live view, the status command and the metrics."""

    client_id: int
    name: str
    endpoint: str
    remote: str
    """Address of the peer; empty while unknown."""
    state: str
    """`open`, or why less is sent: `unproven`, `refused`, `unreachable`, `connecting`,
    `resolving`."""
    trusted: bool
    systems: tuple[tuple[int, int], ...]
    """System and component ids received from it."""
    sent: int
    """Frames handed to the network."""
    dropped: int
    """Frames discarded: unreachable, or the oldest of a full queue."""
    bytes_sent: int
    received: int
    bytes_received: int
    bytes_garbage: int
    """Bytes from it that were not MAVLink."""
    queued: int
    """Frames waiting for a slow link."""
    since_us: int
    heard_us: int | None
    round_trip_us: int | None
    reason: str = ""
    """Why nothing is sent: the operating system's error; empty if frames are sent."""
    unheard: int = 0
    """Frames sent to a port without a listener; they do not count as loss."""
    refused: int = 0
    """Frames that could not be renumbered."""
    receives: bool = True
    """Whether it can send anything; an output of another format cannot."""
    cut: int = 0
    """Datagrams from it that were longer than a read, and lost their end."""
    cached: tuple[str, ...] = ()
    """The kept answers of the systems behind it, with their ages; see `AnswerCache.describe`."""
    note: str = ""
    """A problem of the systems behind it that the settings solve, such as two with one id."""
    hint: str = ""
    """An option that its link should have, and why."""


@dataclass(frozen=True, slots=True)
class ListenerStats:
    """One listening port at one moment."""

    name: str
    endpoint: str
    state: str
    """`open`, or `closed` while it cannot be bound or accept clients."""
    reason: str
    """Why it is closed: the operating system's error; empty if it is open."""
    port: int
    """The port that is bound, or 0."""
    clients: int
    turned_away: int
    """New clients refused because the port was full."""


@dataclass(slots=True)
class HubCounters:
    """Totals of the hub since it started."""

    published: int = 0
    """Frames of ours."""
    forwarded: int = 0
    """Frames of other systems that were passed on."""
    duplicates: int = 0
    """Copies that arrived on a second path."""
    late: int = 0
    """Frames that arrived too long after newer ones of the same stream."""
    shed: int = 0
    """Telemetry of ours dropped because the processor was short of time."""
    looped: int = 0
    """Frames of ours that came back."""
    unroutable: int = 0
    """Frames for an unknown system, or from a client that may not send to it."""
    unserved: int = 0
    """Requests dropped because their client exceeded its quota."""


class LogRateLimiter:
    """Pass `in_full` lines of each minute; count the others, reported with the text `rest`."""

    def __init__(self, in_full: int, rest: str) -> None:
        self._in_full = in_full
        self._rest = rest
        self._begin_us = 0
        self._lines = 0

    def add(self, line: str, now_us: int) -> list[str]:
        """Return the line if it may pass in full, else nothing."""
        found = self.poll(now_us)
        self._lines += 1
        return [*found, line] if self._lines <= self._in_full else found

    def poll(self, now_us: int) -> list[str]:
        """Return at the end of a minute how many lines were suppressed, if any."""
        if now_us - self._begin_us < WINDOW_US:
            return []
        suppressed, self._lines, self._begin_us = self._lines - self._in_full, 0, now_us
        return [f"{suppressed} {self._rest}"] if suppressed > 0 else []


class ClientAlert(NamedTuple):
    """The beginning or the end of a problem."""

    is_problem: bool
    text: str


@dataclass(slots=True)
class _Known:
    """Known problems of a client or listening port."""

    away_since_us: int | None = None
    is_away_reported: bool = False
    note: str = ""
    noted_us: int | None = None
    """Since when the note waits to be announced."""
    dropped: int | None = None
    """Dropped frames at the last update, if the client was open."""
    slow_until_us: int = 0


class ClientAlerts:
    """Detect problems from the figures of clients and listening ports."""

    def __init__(self) -> None:
        self._known: dict[Key, _Known] = {}
        self._limiter = LogRateLimiter(ALERTS_IN_FULL, "more alerts of clients of listening ports")

    def update(
        self,
        clients: tuple[ClientStats, ...],
        listeners: tuple[ListenerStats, ...],
        now_us: int,
    ) -> list[ClientAlert]:
        """Compare all figures with the previous ones."""
        ports = {listener.endpoint for listener in listeners}
        there: tuple[Key, ...] = (*ports, *(client.client_id for client in clients))
        before = self._known
        self._known = {key: before[key] if key in before else _Known() for key in there}
        alerts = [ClientAlert(True, text) for text in self._limiter.poll(now_us)]
        for port in listeners:
            alerts += _outages(self._known[port.endpoint], port.name, port.reason, now_us)
        for client in clients:
            known, state = self._known[client.client_id], ALERT_STATES.get(client.state, "")
            found = _outages(known, client.name, client.reason or state if state else "", now_us)
            found += _drops(known, client, now_us) + _notes(known, client, now_us)
            if client.endpoint in ports:
                found = [
                    ClientAlert(is_problem, line)
                    for is_problem, text in found
                    for line in self._limiter.add(text, now_us)
                ]
            alerts += found
        return alerts


def _outages(known: _Known, name: str, trouble: str, now_us: int) -> list[ClientAlert]:
    if not trouble:
        ended, known.away_since_us, known.is_away_reported = known.is_away_reported, None, False
        return [ClientAlert(False, f"{name} is back")] if ended else []
    if known.away_since_us is None:
        known.away_since_us = now_us
    if known.is_away_reported or now_us - known.away_since_us < ALERT_AFTER_US:
        return []
    known.is_away_reported = True
    return [ClientAlert(True, f"{name}: {trouble}")]


def _notes(known: _Known, client: ClientStats, now_us: int) -> list[ClientAlert]:
    if client.note != known.note:
        known.note, known.noted_us = client.note, now_us if client.note else None
    elif known.noted_us is not None and now_us - known.noted_us >= ALERT_AFTER_US:
        known.noted_us = None
        return [ClientAlert(True, f"{client.name}: {client.note}")]
    return []


def _drops(known: _Known, client: ClientStats, now_us: int) -> list[ClientAlert]:
    before, known.dropped = known.dropped, client.dropped if client.state == "open" else None
    if before is None or known.dropped in (None, before):
        return []
    was_slow, known.slow_until_us = now_us < known.slow_until_us, now_us + SLOW_FOR_US
    text = f"{client.name} is too slow: telemetry dropped"
    return [] if was_slow else [ClientAlert(True, text)]
