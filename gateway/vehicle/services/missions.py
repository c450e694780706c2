"""The mission protocol, both directions, for missions, fences and rally points.

An upload, seen from here:

| state  | event                           | answer                            | next   |
| ------ | ------------------------------- | --------------------------------- | ------ |
| idle   | MISSION_COUNT, 0                | clear, ACK accepted               | idle   |
| idle   | MISSION_COUNT, too many         | ACK no space                      | idle   |
| idle   | MISSION_COUNT                   | REQUEST_INT 0                     | upload |
| upload | the requested item, valid       | REQUEST_INT of the next           | upload |
| upload | the last item, valid            | store all, ACK accepted           | idle   |
| upload | the requested item, invalid     | ACK with the reason               | idle   |
| upload | an item that was received       |                                   | upload |
| upload | a later item                    | REQUEST_INT of the requested one  | upload |
| upload | the same count before any item  |                                   | upload |
| upload | another count, same client      | start again                       | upload |
| upload | MISSION_COUNT, another client   | ACK denied                        | upload |
| upload | MISSION_ACK, not accepted       |                                   | idle   |
| upload | 400 ms without the item         | REQUEST_INT again                 | upload |
| upload | 5 s without a missing item      | ACK cancelled                     | idle   |
| idle   | 400 ms after an upload in which | REQUEST_INT of the last item,     | idle   |
|        | a request had to be repeated    | three times: the ACK may be lost  |        |
| idle   | the last item once more         | ACK accepted again                | idle   |

MAVSDK repeats no item by itself. It counts the half seconds since it sent the newest item, and the
requests for older ones, and gives up at five: so a request is repeated a little sooner than after
half a second, even on a slow link. An item that is therefore received twice is answered once:
otherwise every later item would be sent twice too, and a second ACK would end the next upload.
After a late request MAVSDK returns to its item and ignores requests beyond the next one: so the
item after the newest received one is requested again.

The stored items change only when an upload is complete. A download has no state: each request is
answered from the stored items.

Old clients such as DroneKit support only MISSION_REQUEST and MISSION_ITEM, whose coordinates are
floats. A client that has never used the INT form is answered by MISSION_ITEM. While the form of a
client is unknown, every third request of an upload is a MISSION_REQUEST. A client that refuses that
(MAVSDK, when both requests before were lost) is then sent MISSION_REQUEST_INT only.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.units import US_PER_S
from gateway.vehicle.plan import (
    ACCEPTED,
    KINDS,
    MAX_ITEMS,
    MISSION,
    Item,
    check_item,
    read_item,
    write_item,
)
from gateway.vehicle.service import Answer, Reply, Request, Service

REPEAT_US: Final = 400_000
GIVE_UP_US: Final = 5 * US_PER_S
"""Timeout of an upload without progress; longer than the round trip of a slow link."""
OLD_FORM_EVERY: Final = 3
"""Every n-th request to a client of unknown form is in the older form."""
MAX_CLIENTS: Final = 512
"""Maximum clients whose form is stored."""
CHECKS: Final = 3
"""Number of further requests for the last item when the ACK may have been lost."""
ALL: Final = mavlink.MAV_MISSION_TYPE_ALL
CHANGING: Final = (
    *("MISSION_COUNT", "MISSION_ITEM", "MISSION_ITEM_INT", "MISSION_CLEAR_ALL"),
    *("MISSION_SET_CURRENT", "MISSION_WRITE_PARTIAL_LIST"),
)
UNSUPPORTED: Final = ("MISSION_REQUEST_PARTIAL_LIST", "MISSION_WRITE_PARTIAL_LIST")

Sender = tuple[int, int, int]
"""Client, system and component: several programs may share one client of the hub."""

Items = tuple[Item, ...]
Changed = Callable[[int], list[Answer]]
"""Called with the mission type that was stored, cleared or advanced."""


@dataclass(slots=True)
class _Upload:
    """An upload, kept after its last item, because that may be received again."""

    request: Request
    """The MISSION_COUNT that began it."""
    kind: int
    count: int
    due_us: int
    progress_us: int
    """When the first missing item was first requested."""
    items: list[Item] = field(default_factory=list)
    wanted: int = 0
    """The requested item: the first missing one, or an earlier one where the client resumes."""
    repeats: int = 0
    """Number of repeated requests for it, each of which may still produce a copy of the item."""
    loses: bool = False
    """Whether any request had to be repeated."""
    checks: int = 0
    """Number of requests for the last item that are left, once all have been received."""

    @property
    def is_complete(self) -> bool:
        return len(self.items) == self.count


class MissionService(Service):
    """The stored items of one vehicle."""

    def __init__(
        self,
        changed: Changed,
        explain: Callable[[str, int], list[Answer]],
        empty: Callable[[], Items] = tuple,
    ) -> None:
        """Start without items; `empty` returns the mission that is sent while none is stored."""
        self._empty = empty
        self.items: dict[int, Items] = dict.fromkeys(KINDS, ())
        self.current = 0
        self._changed = changed
        self._explain = explain
        self._forms: dict[Sender, bool] = {}
        """Whether a client has used the INT form; without an entry this is unknown."""
        self._upload: _Upload | None = None
        self._handlers: dict[str, Callable[[Request, int], list[Answer]]] = {
            "MISSION_REQUEST_LIST": self._list,
            "MISSION_REQUEST_INT": self._send_item,
            "MISSION_REQUEST": self._send_item,
            "MISSION_COUNT": self._begin,
            "MISSION_ITEM_INT": self._receive_item,
            "MISSION_ITEM": self._receive_item,
            "MISSION_CLEAR_ALL": self._clear,
            "MISSION_SET_CURRENT": self._set_current,
            "MISSION_ACK": self._end,
        }
        self.types = (*self._handlers, *UNSUPPORTED)

    def changes_state(self, request: Request) -> bool:
        """Return whether the request would store, clear or change the current item."""
        return request.message.get_type() in CHANGING

    def refuse(self, request: Request, _result: int) -> list[Answer]:
        """Deny by MISSION_ACK; MISSION_SET_CURRENT has no negative answer of its own."""
        if request.message.get_type() == "MISSION_SET_CURRENT":
            return []
        return [mission_ack(request, mavlink.MAV_MISSION_DENIED)]

    def handle(self, request: Request, now_us: int) -> list[Answer]:
        """Answer one message."""
        kind = request.message.get_type()
        if kind in ("MISSION_REQUEST_INT", "MISSION_ITEM_INT"):
            self._set_form(request, uses_int=True)
        elif kind in ("MISSION_REQUEST", "MISSION_ITEM"):
            self._set_form(request, uses_int=self._forms.get(_sender(request), False))
        handler = self._handlers.get(kind)
        if handler is None:
            return [mission_ack(request, mavlink.MAV_MISSION_UNSUPPORTED)]
        return handler(request, now_us)

    def poll(self, now_us: int) -> list[Answer]:
        """Request a missing item again, or cancel the upload after the timeout."""
        due_us, upload = self.next_due_us(), self._upload
        if upload is None or due_us is None or now_us < due_us:
            return []
        if upload.is_complete:
            upload.checks -= 1
        elif now_us - upload.progress_us >= GIVE_UP_US:
            self._upload = None
            return [mission_ack(upload.request, mavlink.MAV_MISSION_OPERATION_CANCELLED)]
        else:
            upload.loses = True
            upload.repeats += 1
        return self._ask(upload, now_us)

    def next_due_us(self) -> int | None:
        """Return when `poll` has something to do."""
        upload = self._upload
        if upload is None or (upload.is_complete and not upload.checks):
            return None
        return upload.due_us

    def remove_client(self, client_id: int) -> None:
        """Give up an upload whose client has gone."""
        if self._upload is not None and self._upload.request.client_id == client_id:
            self._upload = None
        self._forms = {key: form for key, form in self._forms.items() if key[0] != client_id}

    def _upload_of(self, request: Request) -> _Upload | None:
        """Return the present or last upload if it is of this client."""
        upload = self._upload
        return upload if upload and upload.request.client_id == request.client_id else None

    def _set_form(self, request: Request, *, uses_int: bool) -> None:
        sender = _sender(request)
        if sender not in self._forms and len(self._forms) >= MAX_CLIENTS:
            self._forms.pop(next(iter(self._forms)))
        self._forms[sender] = uses_int

    def set_current(self, sequence: int) -> list[Answer] | None:
        """Make an item the current one; None if there is no such item."""
        if not 0 <= sequence < len(self.items[MISSION]):
            return None
        self.current = sequence
        return [Reply(self.mission_current()), *self._changed(MISSION)]

    def mission_current(self) -> Any:
        """Encode MISSION_CURRENT; nothing is executed here, so the mission is not started."""
        count = len(self.items[MISSION])
        state = mavlink.MISSION_STATE_NOT_STARTED if count else mavlink.MISSION_STATE_NO_MISSION
        total = count if count else 0xFFFF
        return mavlink.MAVLink_mission_current_message(self.current, total, state, 0)

    def download(self) -> list[Any]:
        """Return the messages of a download of all stored items, without a recipient."""
        found: list[Any] = []
        for kind, items in self.items.items():
            found.append(mavlink.MAVLink_mission_count_message(0, 0, len(items), kind))
            found += [self._item(items, number, kind, (0, 0)) for number in range(len(items))]
        return found

    def _item(
        self, items: Items, sequence: int, kind: int, target: tuple[int, int], floats: bool = False
    ) -> Any:
        is_current = kind == MISSION and sequence == self.current
        return write_item(items[sequence], sequence, kind, target, is_current, floats)

    def _sent(self, kind: int) -> Items:
        return self._empty() if kind == MISSION and not self.items[kind] else self.items[kind]

    def _list(self, request: Request, _now_us: int) -> list[Answer]:
        kind = request.message.mission_type
        if kind not in KINDS:
            return [mission_ack(request, mavlink.MAV_MISSION_UNSUPPORTED)]
        count = mavlink.MAVLink_mission_count_message(
            request.system_id, request.component_id, len(self._sent(kind)), kind
        )
        return [request.reply(count)]

    def _send_item(self, request: Request, _now_us: int) -> list[Answer]:
        kind, sequence = request.message.mission_type, request.message.seq
        if kind not in KINDS:
            return [mission_ack(request, mavlink.MAV_MISSION_UNSUPPORTED)]
        items = self._sent(kind)
        if sequence >= len(items):
            return [mission_ack(request, mavlink.MAV_MISSION_INVALID_SEQUENCE)]
        target, floats = _sender(request)[1:], not self._forms[_sender(request)]
        return [request.reply(self._item(items, sequence, kind, target, floats))]

    def _begin(self, request: Request, now_us: int) -> list[Answer]:
        kind, count = request.message.mission_type, request.message.count
        begun = self._upload
        if begun and not begun.is_complete and not self._upload_of(request):
            return [mission_ack(request, mavlink.MAV_MISSION_DENIED)]
        if kind not in KINDS:
            return [mission_ack(request, mavlink.MAV_MISSION_UNSUPPORTED)]
        if count > MAX_ITEMS[kind]:
            return [mission_ack(request, mavlink.MAV_MISSION_NO_SPACE)]
        if begun and not begun.items and (begun.kind, begun.count) == (kind, count):
            return []
        self._upload = None
        if count == 0:
            return [mission_ack(request, ACCEPTED), *self._store(kind, ())]
        self._upload = _Upload(request, kind, count, now_us, now_us)
        return self._ask(self._upload, now_us)

    def _ask(self, upload: _Upload, now_us: int) -> list[Answer]:
        upload.due_us = now_us + REPEAT_US
        request = upload.request
        request_of = mavlink.MAVLink_mission_request_int_message
        probes_old = upload.repeats % OLD_FORM_EVERY == OLD_FORM_EVERY - 1
        if not self._forms.get(_sender(request), not probes_old):
            request_of = mavlink.MAVLink_mission_request_message
        wanted = request_of(request.system_id, request.component_id, upload.wanted, upload.kind)
        return [request.reply(wanted)]

    def _receive_item(self, request: Request, now_us: int) -> list[Answer]:
        message, upload = request.message, self._upload_of(request)
        if upload is None or upload.is_complete:
            return self._stray_item(request, upload)
        received = len(upload.items)
        if message.seq < received and message.mission_type == upload.kind:
            was_wanted, upload.wanted = message.seq == upload.wanted, message.seq + 1
            return self._ask(upload, now_us) if was_wanted else []
        if message.seq != received or message.mission_type != upload.kind:
            return self._ask(upload, now_us)
        item = read_item(message)
        result = check_item(item, upload.kind)
        if result != ACCEPTED:
            self._upload = None
            return [mission_ack(request, result)]
        upload.items.append(item)
        if received + 1 < upload.count:
            upload.wanted, upload.progress_us, upload.repeats = received + 1, now_us, 0
            return self._ask(upload, now_us)
        upload.wanted, upload.due_us = message.seq, now_us + REPEAT_US
        upload.checks = CHECKS if upload.loses else 0
        return [mission_ack(request, ACCEPTED), *self._store(upload.kind, tuple(upload.items))]

    def _stray_item(self, request: Request, done: _Upload | None) -> list[Answer]:
        """Acknowledge a repeated last item, whose ACK was lost; deny a new one."""
        kind, sequence = request.message.mission_type, request.message.seq
        if done is None or kind != done.kind or sequence >= done.count:
            return [mission_ack(request, mavlink.MAV_MISSION_ERROR)]
        if sequence != done.count - 1:
            return []
        if done.repeats:
            done.repeats -= 1
            return []
        return [mission_ack(request, ACCEPTED)]

    def _store(self, kind: int, items: tuple[Item, ...]) -> list[Answer]:
        self.items[kind] = items
        if kind == MISSION:
            self.current = 0
        return self._changed(kind)

    def _clear(self, request: Request, _now_us: int) -> list[Answer]:
        kind = request.message.mission_type
        if kind not in (*KINDS, ALL):
            return [mission_ack(request, mavlink.MAV_MISSION_UNSUPPORTED)]
        self._upload = None
        answers: list[Answer] = [mission_ack(request, ACCEPTED)]
        for each in KINDS if kind == ALL else (kind,):
            answers += self._store(each, ())
        return answers

    def _set_current(self, request: Request, now_us: int) -> list[Answer]:
        answers, sequence = self.set_current(request.message.seq), request.message.seq
        return self._explain(f"No mission item {sequence}", now_us) if answers is None else answers

    def _end(self, request: Request, now_us: int) -> list[Answer]:
        """Handle a client's MISSION_ACK: the end of its download, or of its own upload.

        An acceptance belongs to a download, even if it arrives after the begin of an upload.
        """
        upload = self._upload_of(request)
        if upload is None or upload.is_complete or request.message.type == ACCEPTED:
            return []
        is_probed = _sender(request) not in self._forms and upload.repeats >= OLD_FORM_EVERY - 1
        if request.message.type == mavlink.MAV_MISSION_UNSUPPORTED and is_probed:
            self._set_form(request, uses_int=True)
            return self._ask(upload, now_us)
        self._upload = None
        return []


def _sender(request: Request) -> Sender:
    return (request.client_id, request.system_id, request.component_id)


def mission_ack(request: Request, result: int) -> Reply:
    """Answer a request about a mission by MISSION_ACK."""
    kind = getattr(request.message, "mission_type", MISSION)
    return request.reply(
        mavlink.MAVLink_mission_ack_message(request.system_id, request.component_id, result, kind)
    )
