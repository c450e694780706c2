"""Announcements: limited in rate; of the boards, when they get worse."""

from typing import Any

import pytest
from msgspec.structs import replace
from pymavlink.dialects.v20 import common as mavlink

from gateway.records import NodeId, PipeCounters, ReceiverStatus
from gateway.vehicle.service import INFO, WARNING, StatusText
from gateway.vehicle.telemetry.announcements import BUCKET, HOLD_US, Announcer
from gateway.vehicle.telemetry.health import QUIET_REPORTS, RADIO_SPAN_US, Finding, Health
from gateway.vehicle.vehicle import Vehicle
from gateway.vehicle.vehicle_settings import RateSettings, VehicleSettings
from gateway.vehicle_state.status_texts import TextJoiner
from tests.kit.ground_station import decode, kinds, of_kind
from tests.kit.mavlink import packed
from tests.kit.records import link, report, status

SECOND_US = 1_000_000
RADIO_REPORTS = RADIO_SPAN_US // SECOND_US
WELL = status(
    time_us=SECOND_US,
    node_time_us=SECOND_US,
    firmware_version=(1, 4),
    bus_errors=65_534,
    radio_failed=10,
    radio_retries=300,
    sample_rate_hz=100,
    supply_mv=3300,
)


class Flying:
    """A vehicle whose one node reports once a second."""

    def __init__(self, **settings: Any) -> None:
        self.vehicle = Vehicle(VehicleSettings(**settings), 1)
        self.status = WELL
        self.reported: list[tuple[int, str]] = []
        self.messages = self._take()

    def report(self, **changes: Any) -> list[Any]:
        """Report once more, a second later."""
        time_us = self.status.time_us + SECOND_US
        changes.setdefault("node_time_us", self.status.node_time_us + SECOND_US)
        self.status = replace(self.status, time_us=time_us, **changes)
        return self._take()

    def _take(self) -> list[Any]:
        return self._note(self.vehicle.on_node_status(self.status, self.status.time_us))

    def _note(self, actions: list[Any]) -> list[Any]:
        found = decode(actions)
        self.reported += [(m.severity, m.text) for m in of_kind(found, "STATUSTEXT")]
        return found

    def link(self, overruns: int) -> None:
        now_us = self.status.time_us
        pipes = (PipeCounters(0, 0, 0), PipeCounters(1, 0, overruns))
        receiver = ReceiverStatus(now_us, now_us, 76, 4, 0, 1, pipes)
        found = report(link(last_time_us=now_us), time_us=now_us, port="port", receiver=receiver)
        self._note(self.vehicle.on_link(found, now_us))


@pytest.fixture
def flying() -> Flying:
    return Flying()


REPORTS: dict[str, tuple[list[dict[str, int]], list[tuple[int, int, str]]]] = {
    # A restart is no error.
    "healthy": ([{}] * 20 + [{"node_time_us": 5, "bus_errors": 0, "radio_failed": 0}], []),
    "low supply": (
        [{"supply_mv": mv} for mv in (3000, 2980, 2960, 3050, 3090, 3000, 2990, *(3100,) * 6)],
        [(1, WARNING, "supply low, 2.98 V"), (7, INFO, "supply OK again, 3.10 V")],
    ),
    # The counter starts again.
    "bus errors": (
        [{"bus_errors": n} for n in (65_535, 0, 1, 2)] + [{}] * QUIET_REPORTS,
        [(0, WARNING, "bus errors, 65535 so far"), (3 + QUIET_REPORTS, INFO, "bus OK again")],
    ),
    "failed radio": (
        [{"radio_failed": n} for n in (50, 109, 110)] + [{}] * RADIO_REPORTS,
        [
            (2, WARNING, "radio sends failed, 100 in 10 s"),
            (1 + RADIO_REPORTS, INFO, "radio OK again"),
        ],
    ),
    **{
        f"few failed of {hz} Hz": (
            [{"sample_rate_hz": hz, "radio_failed": 10 + n // 3} for n in range(60)], [],
        )
        for hz in (10, 0)
    },
}  # fmt: skip
"""Changes of the reports of a node, and the numbers of those that lead to an announcement."""


@pytest.mark.parametrize("name", REPORTS)
def test_trouble_of_a_node_and_its_end_are_announced_once(flying: Flying, name: str) -> None:
    reports, expected = REPORTS[name]
    found = []
    for number, changes in enumerate(reports):
        flying.report(**changes)
        found += [(number, *each) for each in flying.reported]
        flying.reported.clear()
    assert found == [(number, kind, f"IMU node 0: {text}") for number, kind, text in expected]


def test_supply_without_limit_or_measurement_is_not_announced(flying: Flying) -> None:
    unlimited = Flying(supply_low_v=0.0)
    unlimited.report(supply_mv=1000)
    assert "BATTERY_STATUS" not in kinds(flying.report(supply_mv=0))
    assert unlimited.reported == flying.reported == []


def test_new_overruns_of_the_receiver_are_announced(flying: Flying) -> None:
    # What was lost before the gateway came is no news.
    flying.link(2)
    flying.link(3)
    assert flying.reported == [
        (INFO, "Receiver connected: port"),
        (WARNING, "IMU node 0: receiver overrun, 3 so far"),
    ]


def test_battery_status_contains_the_supply_voltage(flying: Flying) -> None:
    (battery,) = flying.messages
    assert (battery.id, battery.voltages[:2]) == (0, [3300, 65535])
    assert battery.charge_state == mavlink.MAV_BATTERY_CHARGE_STATE_OK
    low = flying.report(supply_mv=2900)[0]
    assert low.charge_state == mavlink.MAV_BATTERY_CHARGE_STATE_LOW


@pytest.mark.parametrize(("rate_hz", "count"), [(0.0, 0), (0.5, 5), (10.0, 10)])
def test_battery_status_is_sent_at_its_own_rate(rate_hz: float, count: int) -> None:
    flying = Flying(rates=RateSettings(battery_status_hz=rate_hz))
    found = [kind for _ in range(10) for kind in kinds(flying.report())]
    assert found.count("BATTERY_STATUS") == count


def test_requested_battery_status_is_that_of_the_lowest_supply() -> None:
    health = Health(1, 2.0)
    assert health.newest_battery(0) is None
    health.on_node_status(WELL)
    health.on_node_status(replace(WELL, node=NodeId(1, 1), supply_mv=3100))
    assert health.newest_battery(0).id == 1


def test_sys_status_contains_the_error_counters(flying: Flying) -> None:
    flying.link(7)
    found = flying.vehicle.health.sys_status(flying.status.time_us)
    counts = [getattr(found, f"errors_count{n}") for n in (1, 2, 3, 4)]
    assert counts == [65_534, 10, 300, 7]


def test_autopilot_version_contains_the_firmware_version(flying: Flying) -> None:
    [version] = of_kind(flying.vehicle.introduction(), "AUTOPILOT_VERSION")
    assert version.os_sw_version == 1 << 24 | 4 << 16


GOOD, BAD = StatusText(INFO, "good"), StatusText(WARNING, "bad")


def track(announcer: Announcer, good: bool, now_us: int) -> list[Any]:
    finding = Finding("topic", not good, GOOD if good else BAD)
    return announcer.track(finding, now_us) + announcer.poll(now_us)


def test_announcements_of_a_flapping_state_are_limited_and_end_with_the_true_one() -> None:
    announcer, reported = Announcer(), []
    for n in range(10_001):
        reported += track(announcer, n % 2 == 1, n * 1000)
    reported += announcer.poll(10_000_000 + HOLD_US)
    assert len(reported) <= 4
    assert reported[-1].message.text == "bad"


def test_change_within_the_hold_time_is_announced_at_its_end() -> None:
    announcer = Announcer()
    track(announcer, False, 0)
    assert track(announcer, True, 1000) == []
    assert announcer.next_due_us() == HOLD_US
    assert announcer.poll(HOLD_US - 1) == []
    assert [a.message.text for a in announcer.poll(HOLD_US)] == ["good"]


def test_single_events_are_limited_in_rate() -> None:
    announcer = Announcer()
    assert sum(len(announcer.announce(GOOD, 0)) for _ in range(100)) == BUCKET
    assert len(announcer.announce(GOOD, 500_000)) == 1
    assert announcer.announce(GOOD, 500_001) == []


SIZES = (1, 49, 50, 51, 99, 100, 101, 199)
TEXTS = ["Höhe über 120 m: größer", "aü" * 40, "罗" * 100, *("a" * size for size in SIZES)]


@pytest.mark.parametrize("text", TEXTS)
def test_long_texts_are_sent_in_chunks_as_utf_8_and_cut_between_characters(text: str) -> None:
    found = [answer.message for answer in Announcer().announce(StatusText(INFO, text), 0)]
    assert [m.chunk_seq for m in found] == list(range(len(found)))
    size = len(text.encode())
    assert {m.id == 0 for m in found} == {size <= 50}
    assert len({m.id for m in found}) == 1
    joiner = TextJoiner()
    (joined,) = [each for message in found for each in joiner.feed(packed(message), 0)]
    assert text.startswith(joined.text)
    assert len(joined.text.encode()) > min(size, 200) - 3
