"""The newest MAVLink message of each kind, as the tree of mavlink2rest."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Final

from gateway.wire.mavlink_json import to_json

MAX_KINDS: Final = 8192
"""Enough for some fifty aircraft; forged ids must not fill the memory."""

Key = tuple[int, int, str]
"""System, component and name of the message."""


@dataclass(slots=True)
class _Entry:
    message: Any
    first_s: float
    last_s: float
    counter: int = 1

    def as_json(self) -> dict[str, Any]:
        span_s = self.last_s - self.first_s
        return {
            "message": to_json(self.message),
            "status": {
                "time": {
                    "first_update": _written(self.first_s),
                    "last_update": _written(self.last_s),
                    "counter": self.counter,
                    "frequency": (self.counter - 1) / span_s if span_s > 0 else 0.0,
                }
            },
        }


class MessageBook:
    """Received MAVLink messages, as a tree.

    Parameters
    ----------
    now_s : callable
        Civil time in s since the epoch, to show when a message came.
    """

    def __init__(self, now_s: Callable[[], float]) -> None:
        self._now_s = now_s
        self._entries: dict[Key, _Entry] = {}
        self._heard: set[tuple[int, int]] = set()
        self.left_out = 0
        """Messages of kinds for which there was no room."""

    def take(self, message: Any, *, is_sent: bool = False) -> None:
        """Take in one message, received or sent from here."""
        key = (message.get_srcSystem(), message.get_srcComponent(), message.msgname)
        if not is_sent:
            self._heard.add(key[:2])
        now_s = self._now_s()
        entry = self._entries.get(key)
        if entry is not None:
            entry.message = message
            entry.last_s = now_s
            entry.counter += 1
        elif len(self._entries) < MAX_KINDS:
            self._entries[key] = _Entry(message, now_s, now_s)
        else:
            self.left_out += 1

    def has_heard(self, system_id: int, component_id: int) -> bool:
        """Return whether anything came from a component."""
        return (system_id, component_id) in self._heard

    def look_up(self, path: str) -> Any:
        """Return the value at a path of the tree.

        Parameters
        ----------
        path : str
            As in `vehicles/1/components/1/messages/ATTITUDE/message/roll`; empty is all. A JSON
            pointer without its first slash, so a trailing slash means an empty name.

        Returns
        -------
        Any
            A JSON value.

        Raises
        ------
        KeyError
            If the path does not exist.
        """
        parts = path.split("/") if path else []
        node: Any = self._tree(parts)
        for part in parts:
            if isinstance(node, dict):
                node = node[part]
            elif isinstance(node, list) and part in map(str, range(len(node))):
                node = node[int(part)]
            else:
                raise KeyError(part)
        return node

    def _tree(self, parts: list[str]) -> dict[str, Any]:
        """Build as much of the tree as a path needs."""
        vehicles: dict[str, Any] = {}
        for (system_id, component_id, name), entry in self._chosen(parts):
            vehicle = vehicles.setdefault(str(system_id), {"id": system_id, "components": {}})
            component = vehicle["components"].setdefault(
                str(component_id), {"id": component_id, "messages": {}}
            )
            component["messages"][name] = entry.as_json()
        return {"vehicles": vehicles}

    def _chosen(self, parts: list[str]) -> Iterator[tuple[Key, _Entry]]:
        wanted = [*parts[1::2], "", "", ""] if parts[:1] == ["vehicles"] else [""] * 3
        for key, entry in self._entries.items():
            if all(want in ("", str(have)) for want, have in zip(wanted, key, strict=False)):
                yield key, entry


def _written(time_s: float) -> str:
    return datetime.fromtimestamp(time_s, UTC).astimezone().isoformat()
