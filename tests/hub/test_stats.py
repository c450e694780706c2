"""Alerts of clients with problems, on the manual clock."""

import dataclasses

import pytest

from gateway.hub.stats import (
    ALERT_AFTER_US,
    SLOW_FOR_US,
    WINDOW_US,
    ClientAlerts,
    ClientStats,
    ListenerStats,
    LogRateLimiter,
)
from tests.client_stats import TABLET

S = 1_000_000


def client(**changes: object) -> tuple[ClientStats, ...]:
    return (dataclasses.replace(TABLET, **changes),)


def look(watch: ClientAlerts, clients: tuple[ClientStats, ...], now_us: int) -> list[str]:
    return [text for _, text in watch.update(clients, (), now_us)]


AWAY = client(state="unreachable")


@pytest.mark.parametrize(
    ("looks", "texts"),
    [
        pytest.param(
            [(0, AWAY), (ALERT_AFTER_US - 1, AWAY), (ALERT_AFTER_US, client()),
             (ALERT_AFTER_US + 1, AWAY)],
            [],
            id="short outages",
        ),
        pytest.param(
            [*((n * S, AWAY) for n in range(20)), (21 * S, client()), (22 * S, client())],
            ["tablet: unreachable", "tablet is back"],
            id="one long outage",
        ),
        pytest.param(
            [(0, AWAY), (ALERT_AFTER_US, AWAY)], ["tablet: unreachable"], id="at the limit"
        ),
        pytest.param(
            [(n * S, client(dropped=10 * (n // 2))) for n in range(9)],
            ["tablet is too slow: telemetry dropped"],
            id="drops with short pauses",
        ),
        pytest.param(
            [(n * S, client(state="connecting")) for n in range(20)],
            ["tablet: not connected"],
            id="lost router",
        ),
        pytest.param(
            [(n * S, client(state="unreachable", reason="Permission denied")) for n in range(20)],
            ["tablet: Permission denied"],
            id="known reason",
        ),
        pytest.param(
            [(n * S, client(state="refused")) for n in range(20)], [], id="refusing station"
        ),
        pytest.param(
            [*((n * S, client(dropped=n * 10)) for n in range(10)),
             *((n * S, client(dropped=90)) for n in range(10, 50)), (60 * S, client(dropped=91))],
            ["tablet is too slow: telemetry dropped"] * 2,
            id="drops before and after a pause",
        ),
        pytest.param(
            [*((n * S, client(note="two with id 1")) for n in range(20)), (20 * S, client()),
             (21 * S, client(note="short"))],
            ["tablet: two with id 1"],
            id="note",
        ),
        pytest.param(
            [(0, client(state="unreachable", dropped=10)), (S, client(dropped=20)),
             (2 * S, client(dropped=20))],
            [],
            id="drops during an outage",
        ),
    ],
)  # fmt: skip
def test_lasting_problem_and_its_end_are_reported_once(
    looks: list[tuple[int, tuple[ClientStats, ...]]], texts: list[str]
) -> None:
    watch = ClientAlerts()
    assert [text for now_us, clients in looks for text in look(watch, clients, now_us)] == texts
    assert SLOW_FOR_US < 40 * S


def test_closed_port_is_reported_until_it_is_open() -> None:
    watch, taken = ClientAlerts(), "Address already in use"
    closed = ListenerStats("here", "udp-listen:0.0.0.0:14550", "closed", taken, 0, 0, 0)
    news = [each for n in range(20) for each in watch.update((), (closed,), n * S)]
    assert news == [(True, f"here: {taken}")]
    opened = dataclasses.replace(closed, state="open", reason="", port=14550)
    assert watch.update((), (opened,), 21 * S) == [(False, "here is back")]
    assert watch.update((), (closed,), 22 * S) == watch.update((), (), 23 * S) == []
    assert watch.update((), (closed,), 23 * S + ALERT_AFTER_US - 1) == [], "another port"


def test_state_of_a_client_that_left_is_discarded() -> None:
    watch, slow = ClientAlerts(), ["tablet is too slow: telemetry dropped"]
    assert [look(watch, client(dropped=n), n * S) for n in range(2)] == [[], slow]
    assert look(watch, (), 2 * S) == []
    assert look(watch, client(dropped=9), 3 * S) == [], "another client"
    assert [look(watch, AWAY, n * S) for n in range(4, 20)].count([]) == 15
    assert look(watch, (), 20 * S) == []
    assert look(watch, client(), 21 * S) == look(watch, AWAY, 22 * S) == []


def test_alerts_of_unknown_clients_are_summed_up_and_of_a_configured_one_named() -> None:
    watch, port = ClientAlerts(), "udp-listen:0.0.0.0:14551"
    listeners = (ListenerStats("port", port, "open", "", 14551, 0, 0),)
    texts = []
    for n in range(100):
        unknown = tuple(
            dataclasses.replace(
                TABLET, client_id=100 + number, name=f"unknown {number}", endpoint=port, dropped=n
            )
            for number in range(n * 10, n * 10 + 20)
        )
        clients = (*client(dropped=100 * (n >= 50)), *unknown)
        texts += [text for _, text in watch.update(clients, listeners, n * S)]
    assert texts.count("tablet is too slow: telemetry dropped") == 1
    assert len([text for text in texts if text.startswith("unknown")]) == 2 * 3
    (summed,) = [text for text in texts if "more alerts" in text]
    assert int(summed.split()[0]) > 500
    assert len(texts) == 8


def test_lines_beyond_the_limit_are_counted() -> None:
    limiter = LogRateLimiter(2, "more came")
    assert [limiter.add(line, 0) for line in "abcde"] == [["a"], ["b"], [], [], []]
    assert limiter.poll(WINDOW_US - 1) == []
    assert limiter.poll(WINDOW_US) == ["3 more came"]
    assert limiter.poll(3 * WINDOW_US) == []
    assert limiter.add("f", 3 * WINDOW_US) == ["f"]


def test_number_of_suppressed_lines_precedes_the_next_line() -> None:
    limiter = LogRateLimiter(1, "more came")
    for line in "abc":
        limiter.add(line, 0)
    assert limiter.add("d", WINDOW_US) == ["2 more came", "d"]
