"""Conversations of stations with a vehicle: who sends what, and what is expected within a time."""

from typing import Any

from tests.conftest import ManualClock
from tests.kit.ground_station import GroundStation, kinds, of_kind, texts

Step = tuple[Any, ...]
"""A station, "A" unless given; an action: a message, bytes, a time to wait in s, None to read what
has come, "leave", or a function of the station; and what it has received and led to then.

That is, by kind: fields of the last message, or how many there are; by KIND.field: the values of
all messages; `texts` are the texts, `kinds` all kinds in their order, `actions` what the vehicle
asked of the gateway. Nothing at all is received in answer to a message without any; whatever
comes is accepted where it is `...`."""


def converse(
    vehicle: Any, clock: ManualClock, steps: list[Step], systems: dict[str, int] | None = None
) -> dict[str, GroundStation]:
    """Let stations converse with a vehicle; return them by name.

    The system id of a station is that of the first letter of its name. Its name ends in
    "untrusted" if it may not change anything, and in "v1" if it sends MAVLink 1.
    """
    stations: dict[str, GroundStation] = {}
    for number, step in enumerate(steps):
        name, action, expected = step if len(step) == 3 else ("A", *step)
        if name not in stations:
            stations[name] = GroundStation(
                vehicle, clock, client_id=7 + len(stations),
                system_id=(systems or {}).get(name[0], 255),
                trusted=not name.endswith("untrusted"), version=1 if name.endswith("v1") else 2,
            )  # fmt: skip
        me = stations[name]
        before, actions = len(me.inbox), len(me.actions)
        _act(me, action, stations)
        if expected is ...:
            continue
        found = me.inbox if action is None else me.inbox[before:]
        where = (number, name, kinds(found))
        assert found == [] or expected or isinstance(action, float), where
        _check(found, me.actions[actions:], expected, where)
    return stations


def _act(me: GroundStation, action: Any, stations: dict[str, GroundStation]) -> None:
    if isinstance(action, float):
        me.wait(action)
    elif action == "leave":
        me.vehicle.remove_client(me.client_id)
    elif callable(action):
        action(me)
    elif action is not None:
        sent = len(me.frames)
        me.send_bytes(action) if isinstance(action, bytes) else me.send(action)
        for other in stations.values():
            if other is not me:
                other.receive(f for f in me.frames[sent:] if f.client_id == other.client_id)


def perform(name: str, *values: Any, **options: Any) -> Any:
    """Return an action that calls the vehicle, such as `on_gps`, and receives its frames."""
    return lambda me: me.receive(getattr(me.vehicle, name)(*values, **options) or ())


def _check(found: list[Any], actions: list[Any], expected: dict[str, Any], where: Any) -> None:
    whole = {"texts": texts, "kinds": kinds, "actions": lambda _: actions}
    for key, wanted in expected.items():
        kind, _, field = key.partition(".")
        if kind in whole:
            assert whole[kind](found) == wanted, (where, kind)
            continue
        messages = of_kind(found, kind) if found else []
        if field:
            assert [getattr(message, field) for message in messages] == wanted, (where, key)
        elif isinstance(wanted, dict):
            assert messages, (where, kind)
            for name, value in wanted.items():
                got = getattr(messages[-1], name)
                got = got[: len(value)] if isinstance(value, bytes) else got
                assert got == value, (where, kind, name)
        else:
            assert len(messages) == wanted, (where, kind)
