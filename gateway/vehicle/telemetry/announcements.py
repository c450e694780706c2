"""Events of one aircraft as STATUSTEXT, at a limited rate: link, nodes, GPS, estimator flags.

Theory of operation. Every topic ("link", "GPS fix", a flag of the estimator) has a state, and only
a change of state is announced. After that the topic is held for `HOLD_US`; further changes in this
time are merged: at the end of the hold its state is announced if it differs from the last one
announced. A flapping topic thus causes at most one text in `HOLD_US`, and the last text is always
right. Single events that have no state go through `announce`, at most `BUCKET` at once and one more
every `REFILL_US`.

One cause gives one text, and its end one more. A topic that follows from others (`CAUSES`) is
announced as bad only after `GRACE_US` in which none of them was bad: a GPS node without data also
causes the loss of the fix and then of the position, and they recover in any order.
"""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.records import ImuFlags, ImuSample, LinkReport, NavFlags, NavState
from gateway.token_bucket import TokenBucket
from gateway.units import US_PER_S
from gateway.vehicle.service import CRITICAL, INFO, NOTICE, WARNING, Answer, Reply, StatusText
from gateway.vehicle.telemetry.health import GPS, Finding, Health, status_text

HOLD_US: Final = 5 * US_PER_S
GRACE_US: Final = 4 * US_PER_S
"""Longest time between a cause and its consequences: a cause is found a few seconds after the first
of them, and ends as long before the last one ends."""
BUCKET: Final = 10
REFILL_US: Final = US_PER_S // 2
TEXT_BYTES: Final = 50
"""Length of the text of STATUSTEXT; longer texts are sent in chunks."""
MAX_TEXT_BYTES: Final = 4 * TEXT_BYTES
FlagTexts = tuple[tuple[NavFlags | ImuFlags, str, str], ...]
"""A flag, the text when it is set, and the text when it is cleared."""
FLAG_TEXTS: Final[FlagTexts] = (
    (NavFlags.ATTITUDE_VALID, "Attitude valid", "Attitude not valid"),
    (NavFlags.HEADING_VALID, "Heading valid", "Heading not valid"),
    (NavFlags.DEAD_RECKONING, "Position is dead-reckoned", "Position follows GPS again"),
    (NavFlags.GPS_REJECTED, "GPS fixes rejected", "GPS accepted again"),
    (
        NavFlags.MAG_MISPLACED,
        "Compass axes wrong, not used: check CAL_MAG_MNT",
        "Compass axes right again",
    ),
    (NavFlags.MAG_DISTURBED, "Magnetic field disturbed", "Magnetic field normal again"),
    (NavFlags.SENSOR_FAULT, "Sensor fault", "Sensors OK again"),
)
"""Texts of the flags of the estimator. DEGRADED only repeats one of the others."""
CAUSES: Final[dict[NavFlags | ImuFlags, tuple[str, ...]]] = {
    NavFlags.ATTITUDE_VALID: ("SENSOR_FAULT",),
    NavFlags.HEADING_VALID: ("ATTITUDE_VALID", "SENSOR_FAULT", "MAG_DISTURBED", "MAG_MISPLACED"),
    NavFlags.MAG_DISTURBED: ("MAG_MISPLACED",),
    NavFlags.DEAD_RECKONING: ("GPS", "GPS_REJECTED"),
}
"""Topics that may cause a flag."""
GOOD_FLAGS: Final = (NavFlags.ATTITUDE_VALID, NavFlags.HEADING_VALID)
GPS_FIX: Final = Finding("GPS", True, StatusText(INFO, "GPS fix"))
GPS_LOST: Final = Finding("GPS", False, StatusText(WARNING, "GPS fix lost"))
CALIBRATION_TEXTS: Final[FlagTexts] = (
    (ImuFlags.MAG_UNCALIBRATED, "Compass not calibrated", "Compass calibrated"),
    (ImuFlags.ACCEL_UNCALIBRATED, "Accelerometer not calibrated", "Accelerometer calibrated"),
)
"""Texts of the flags of the sensors."""
UNCALIBRATED: Final = sum(int(flag) for flag, _, _ in CALIBRATION_TEXTS)
INERTIAL: Final = UNCALIBRATED & ~int(ImuFlags.MAG_UNCALIBRATED)
LATENCY_PARAMETER: Final = "REF_GPS_LATENCY"
LATENCY_SETTLED_US: Final = 60 * US_PER_S
LATENCY_SPREAD_S: Final = 0.02
"""A latency has converged if it has changed by less in `LATENCY_SETTLED_US`; after the first
manoeuvres of a flight its error may be 0.08 s."""
RESTART_REPORTS: Final = 10
"""Reports of the link, one a second, in which restarts of a node are counted."""
MANY_RESTARTS: Final = 3


@dataclass(slots=True)
class _Topic:
    state: object
    announced: object
    text: StatusText
    causes: tuple[str, ...] = ()
    held_until_us: int = 0
    """Its state is not announced before this time."""
    bad_us: int = -GRACE_US - 1
    """When it was last bad."""

    @property
    def is_bad(self) -> bool:
        return bool(self.text.severity <= WARNING)


class Announcer:
    """Texts about changes of state, and at most `bucket` single events at once."""

    def __init__(self, bucket: int = BUCKET, refill_us: int = REFILL_US) -> None:
        self._topics: dict[str, _Topic] = {}
        self._pending: dict[str, _Topic] = {}
        """Topics whose state is not announced yet."""
        self._bucket = TokenBucket(US_PER_S / refill_us, bucket)
        self._next_id = 0

    @property
    def troubles(self) -> dict[str, str]:
        """The texts of the severe states that are announced and last, by topic."""
        return {
            name: topic.text.text
            for name, topic in self._topics.items()
            if topic.text.severity <= CRITICAL and topic.announced == topic.state
        }

    def track(self, finding: Finding, now_us: int) -> list[Answer]:
        """Note the present state of a topic, and announce it if it changed."""
        topic, state, text, causes = finding
        known = self._topics.get(topic)
        if known is None:
            known = self._topics[topic] = _Topic(False, False, text)
        was_bad = known.is_bad and known.state == state
        known.state, known.text, known.causes = state, text, causes
        if known.is_bad:
            if causes and not was_bad and now_us - known.bad_us > GRACE_US:
                known.held_until_us = max(known.held_until_us, now_us + GRACE_US)
            known.bad_us = now_us
        if state == known.announced:
            self._pending.pop(topic, None)
            return []
        self._pending[topic] = known
        return self._announce(topic, now_us)

    def announce(self, text: StatusText, now_us: int) -> list[Answer]:
        """Announce a single event, unless there were too many recently."""
        return chunks(text, self._number()) if self._bucket.take(now_us) else []

    def poll(self, now_us: int) -> list[Answer]:
        """Return the states that changed while their topics were held."""
        return [a for name in tuple(self._pending) for a in self._announce(name, now_us)]

    def next_due_us(self) -> int | None:
        """Return when `poll` has something to announce."""
        return min((topic.held_until_us for topic in self._pending.values()), default=None)

    def _announce(self, name: str, now_us: int) -> list[Answer]:
        """Announce a pending topic, unless it is held or follows from another."""
        topic = self._pending[name]
        if now_us < topic.held_until_us:
            return []
        causes = (self._topics[name] for name in topic.causes if name in self._topics)
        if topic.is_bad and any(cause.is_bad for cause in causes):
            topic.held_until_us = now_us + GRACE_US
            return []
        del self._pending[name]
        topic.announced = topic.state
        topic.held_until_us = now_us + HOLD_US
        return chunks(topic.text, self._number())

    def _number(self) -> int:
        self._next_id = self._next_id % 0xFFFF + 1
        return self._next_id


def utf8(text: str, size: int) -> bytes:
    """Encode a text in at most `size` bytes, without a partial character at its end."""
    return text.encode(errors="replace")[:size].decode(errors="ignore").encode()


def chunks(text: StatusText, number: int = 1) -> list[Answer]:
    """Encode a text as one STATUSTEXT, or as several chunks."""
    data = utf8(text.text, MAX_TEXT_BYTES)
    if len(data) <= TEXT_BYTES:
        # The id 0 means a text of one chunk.
        return [Reply(mavlink.MAVLink_statustext_message(text.severity, data))]
    # A receiver treats a chunk that is not full as the last one.
    starts = range(0, len(data) + (len(data) % TEXT_BYTES == 0), TEXT_BYTES)
    parts = (data[start : start + TEXT_BYTES] for start in starts)
    message = mavlink.MAVLink_statustext_message
    return [Reply(message(text.severity, part, number, n)) for n, part in enumerate(parts)]


class Announcements(Announcer):
    """The announcements of one aircraft."""

    def __init__(self, health: Health) -> None:
        super().__init__()
        self._health = health
        self._flags = NavFlags(0)
        self._uncalibrated = 0
        self._restarts: dict[int, deque[int]] = {}
        """Number of restarts of each node in the last reports."""
        self._latency_s: float | None = None
        self._latency_since_us = 0

    def on_state(self, state: NavState, sample: ImuSample, now_us: int) -> list[Answer]:
        """Announce changes of the sensors' and the estimator's flags."""
        changed = (sample.flags & UNCALIBRATED) ^ self._uncalibrated
        if changed and sample.mag_b_ut is None:
            # The compass is announced only once it has measured a field.
            changed &= INERTIAL
        found: list[Answer] = []
        if changed:
            self._uncalibrated ^= changed
            found += self._on_flags(CALIBRATION_TEXTS, changed, self._uncalibrated, now_us)
        if state.flags != self._flags:
            changed, self._flags = state.flags ^ self._flags, state.flags
            found += self._on_flags(FLAG_TEXTS, changed, state.flags, now_us)
        return found

    def _on_flags(self, texts: FlagTexts, changed: int, flags: int, now_us: int) -> list[Answer]:
        found = []
        for flag, raised, fallen in texts:
            if changed & flag:
                is_raised, is_good = bool(flags & flag), flag in GOOD_FLAGS
                severity = CRITICAL if flag is NavFlags.SENSOR_FAULT else WARNING
                bad, good = (fallen, raised) if is_good else (raised, fallen)
                text = status_text(is_raised != is_good, bad, good, severity)
                causes = CAUSES.get(flag, ())
                found.append(Finding(str(flag.name), is_raised, text, causes))
        return self.on_findings(found, now_us)

    def on_fix(self, now_us: int) -> list[Answer]:
        """Announce whether GPS fixes arrive."""
        if self._health.has_fix(now_us):
            return self.track(GPS_FIX, now_us)
        causes: tuple[str, ...] = ()
        if not self._health.is_alive(GPS, now_us):
            causes = ("link", *(f"node {number}" for number in self._health.gps_nodes()))
        return self.track(GPS_LOST._replace(causes=causes), now_us)

    def on_latency(self, used_s: float, set_s: float, now_us: int) -> list[Answer]:
        """Announce once that the estimated latency of fixes differs from the setting.

        The latency in use approaches the estimate slowly, and stays constant while fixes are lost.
        """
        known_s = self._latency_s
        if known_s is None or abs(used_s - known_s) > LATENCY_SPREAD_S:
            self._latency_s, self._latency_since_us = used_s, now_us
        if used_s == set_s or now_us - self._latency_since_us < LATENCY_SETTLED_US:
            return []
        text = f"GPS is {used_s:.2f} s late, not {set_s:.2f}: set {LATENCY_PARAMETER}"
        finding = Finding("latency", f"{set_s} s is wrong", StatusText(NOTICE, text))
        return self.track(finding, now_us)

    def on_findings(self, findings: Iterable[Finding], now_us: int) -> list[Answer]:
        """Announce changes of state."""
        return [a for finding in findings for a in self.track(finding, now_us)]

    def on_link(self, report: LinkReport, now_us: int) -> list[Answer]:
        """Announce that the receiver or a node is lost or is back."""
        lost, back = f"{report.name} lost: {report.port}", f"{report.name} connected: {report.port}"
        text = status_text(not report.connected, lost, back, CRITICAL)
        findings = [Finding("link", "connected" if report.connected else "lost", text)]
        if not report.connected:
            # Without the receiver all nodes time out, which is not announced.
            return self.on_findings(findings, now_us)
        silent = self._health.silent_nodes(now_us)
        for node in sorted(self._health.known_nodes()):
            name, is_silent = self._health.node_name(node), node in silent
            text = status_text(is_silent, f"{name} silent", f"{name} is back", CRITICAL)
            findings.append(Finding(f"node {node}", is_silent, text))
        return self.on_findings(findings, now_us) + self._on_restarts(now_us)

    def poll(self, now_us: int) -> list[Answer]:
        """Announce the changes of topics whose hold has ended."""
        return self.on_fix(now_us) + super().poll(now_us)

    def _on_restarts(self, now_us: int) -> list[Answer]:
        """Announce restarts one by one; frequent ones as a state, since no board starts so fast."""
        found = []
        for node, restarts in sorted(self._health.restarts().items()):
            known = self._restarts.setdefault(node, deque([restarts], RESTART_REPORTS))
            is_new, is_often = restarts > known[-1], restarts - known[0] >= MANY_RESTARTS
            known.append(restarts)
            name = self._health.node_name(node)
            often = f"{name} keeps restarting, or two nodes share id {node}"
            text = status_text(is_often, often, f"{name} no longer restarts", CRITICAL)
            found += self.track(Finding(f"restarts {node}", is_often, text), now_us)
            if is_new and not is_often:
                found += self.announce(StatusText(WARNING, f"{name} restarted"), now_us)
        return found
