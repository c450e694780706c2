"""Conversations of stations with a vehicle: who sends what, and what is expected within a time."""

from typing import Any

from tests.conftest import ManualClock
from tests.kit.ground_station import GroundStation, kinds, of_kind, texts

Step = tuple[str, Any, dict[str, Any]]
"""A station; an action: a message, a time to wait in s, None to read what has come, "leave", or a
function of vehicle and time that returns actions; and what the station has received then. That is,
by kind: fields of the last message, or how many there are; `texts` are the texts, `kinds` all kinds
in their order. Nothing at all is received in answer to a message without any."""


def converse(
    vehicle: Any, clock: ManualClock, steps: list[Step], systems: dict[str, int] | None = None
) -> dict[str, GroundStation]:
    """Let stations converse with a vehicle; return them by name.

    The system id of a station is that of the first letter of its name, and "untrusted" ends the
    name of one that may not change anything.
    """
    stations: dict[str, GroundStation] = {}
    for number, (name, action, expected) in enumerate(steps):
        if name not in stations:
            stations[name] = GroundStation(
                vehicle, clock, client_id=7 + len(stations),
                system_id=(systems or {}).get(name[0], 255), trusted=not name.endswith("untrusted"),
            )  # fmt: skip
        me = stations[name]
        before = len(me.inbox)
        if isinstance(action, float):
            me.wait(action)
        elif action == "leave":
            vehicle.remove_client(me.client_id)
        elif callable(action):
            me.receive(action(vehicle, clock.now_us))
        elif action is not None:
            sent = len(me.frames)
            me.send(action)
            for other in stations.values():
                if other is not me:
                    other.receive(f for f in me.frames[sent:] if f.client_id == other.client_id)
        found = me.inbox if action is None else me.inbox[before:]
        assert found == [] or expected or isinstance(action, float), (number, name)
        _check(found, expected, (number, name))
    return stations


def _check(found: list[Any], expected: dict[str, Any], where: tuple[int, str]) -> None:
    for kind, wanted in expected.items():
        if kind in ("texts", "kinds"):
            assert (texts if kind == "texts" else kinds)(found) == wanted, where
            continue
        messages = of_kind(found, kind) if found else []
        if isinstance(wanted, int):
            assert abs(len(messages) - wanted) <= (wanted > 0), (where, kind)
            continue
        assert messages, (where, kind)
        for field, value in wanted.items():
            got = getattr(messages[-1], field)
            got = got[: len(value)] if isinstance(value, bytes) else got
            assert got == value, (where, kind, field)
