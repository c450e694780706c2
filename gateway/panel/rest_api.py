"""MAVLink for scripts and pages: REST and JSON over WebSocket, compatible with mavlink2rest.

All paths exist with and without `/v1` in front, and below `/mavlink2rest`. Viewers may not send.

Each message is encoded once for all subscribers, and a slow subscriber loses its own oldest
messages. Regular expressions are those of Rust, as in mavlink2rest: that engine, which pydantic
includes, takes linear time for any expression, but Python's own takes exponential time for some.

References
----------
.. [1] https://github.com/mavlink/mavlink2rest, README and `/docs`
"""

import asyncio
import json
import time
from collections import Counter, deque
from collections.abc import AsyncIterator, Callable, Iterator, Set
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from http import HTTPStatus
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

import msgspec
from fastapi import APIRouter, Request, Response
from pydantic_core import SchemaError, SchemaValidator, core_schema
from starlette.responses import FileResponse, StreamingResponse
from starlette.status import WS_1008_POLICY_VIOLATION
from starlette.websockets import WebSocket, WebSocketDisconnect

from gateway import __version__
from gateway.hub.endpoint import selection_from
from gateway.hub.systems import NO_FILTER, SystemFilter
from gateway.panel.access import ROLE
from gateway.panel.admission import Role
from gateway.panel.uplink import Uplink
from gateway.wire.mavlink_json import CLASSES, BadMessageError, from_json, template, to_json

MAX_KINDS: Final = 8192
"""Maximum entries: enough for some fifty aircraft; forged ids must not fill the memory."""
MAX_KINDS_OF_SYSTEM: Final = 1024
"""Maximum entries of a system; an aircraft and its components send some hundred."""
DROPPED_SHARE: Final = 8
"""Divisor for the share of a full table that is dropped at once, the oldest entries first."""

Key = tuple[int, int, str]
"""System, component and name of the message."""
MAX_WAITING_BYTES: Final = 1 << 20
"""Maximum waiting bytes of one subscriber: some seconds of one aircraft."""
MAX_PATTERN: Final = 300
"""Maximum characters of an expression; the longest is compiled in some milliseconds."""
EVERYTHING: Final = ".*"
PIECE: Final = 1 << 15
"""Bytes that are encoded before others get their turn: some milliseconds."""
JSON: Final = "application/json"
API_VERSION: Final = 0
"""Version of the answers' format, as in mavlink2rest."""
DEFAULT_HEADER: Final = {"system_id": 255, "component_id": 0, "sequence": 0}
MAX_ID: Final = 255
NOTHING: Final = "None"
NOT_A_MESSAGE: Final = "Failed to parse message, not a valid MAVLinkMessage."
NOT_ALLOWED: Final = "viewers may not send; log in as the operator"
WS_INVALID: Final = 1007
PREFIX: Final = "/mavlink2rest"
"""Prefix under which some clients expect these paths, as BlueOS serves them."""
DOCS: Final = Path(__file__).parent / "web" / "rest.html"
DOCS_POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


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
                    "first_update": _iso_time(self.first_s),
                    "last_update": _iso_time(self.last_s),
                    "counter": self.counter,
                    "frequency": (self.counter - 1) / span_s if span_s > 0 else 0.0,
                }
            },
        }


class MessageBook:
    """Received MAVLink messages, as a tree."""

    def __init__(self, now_s: Callable[[], float]) -> None:
        self._now_s = now_s
        self._entries: dict[Key, _Entry] = {}
        self._received: set[tuple[int, int]] = set()
        self._kinds: Counter[int] = Counter()
        """Entries by system."""

    def add(self, message: Any, *, is_sent: bool = False) -> None:
        """Add one message, received or sent from here."""
        key = (message.get_srcSystem(), message.get_srcComponent(), message.msgname)
        if not is_sent:
            self._received.add(key[:2])
        now_s = self._now_s()
        entry = self._entries.get(key)
        if entry is not None:
            entry.message = message
            entry.last_s = now_s
            entry.counter += 1
        else:
            if self._kinds[key[0]] >= MAX_KINDS_OF_SYSTEM:
                self._drop(key[0])
            elif len(self._entries) >= MAX_KINDS:
                self._drop(None)
            self._entries[key] = _Entry(message, now_s, now_s)
            self._kinds[key[0]] += 1

    def _drop(self, system_id: int | None) -> None:
        """Drop the entries that were updated longest ago, of one system or of all."""
        keys = [key for key in self._entries if system_id in (None, key[0])]
        keys.sort(key=lambda key: self._entries[key].last_s)
        for key in keys[: max(1, len(keys) // DROPPED_SHARE)]:
            del self._entries[key]
            self._kinds[key[0]] -= 1

    def has_heard(self, system_id: int, component_id: int) -> bool:
        """Return whether a message was received from a component."""
        return (system_id, component_id) in self._received

    def look_up(self, path: str, systems: SystemFilter = NO_FILTER) -> Any:
        """Return the value at a path such as `vehicles/1/components/1/messages/ATTITUDE`.

        It is a JSON pointer without its first slash; an empty one is the whole tree of the systems
        that pass, whose entries `encode` converts. Raises KeyError if there is no value.
        """
        parts = path.split("/") if path else []
        node: Any = self._tree(parts, systems)
        for part in parts:
            if isinstance(node, _Entry):
                node = node.as_json()
            if isinstance(node, dict):
                node = node[part]
            elif isinstance(node, list) and part in map(str, range(len(node))):
                node = node[int(part)]
            else:
                raise KeyError(part)
        return node.as_json() if isinstance(node, _Entry) else node

    def _tree(self, parts: list[str], systems: SystemFilter) -> dict[str, Any]:
        vehicles: dict[str, Any] = {}
        for (system_id, component_id, name), entry in self._chosen(parts):
            if not systems.has((system_id, component_id)):
                continue
            vehicle = vehicles.setdefault(str(system_id), {"id": system_id, "components": {}})
            component = vehicle["components"].setdefault(
                str(component_id), {"id": component_id, "messages": {}}
            )
            component["messages"][name] = entry
        return {"vehicles": vehicles}

    def _chosen(self, parts: list[str]) -> Iterator[tuple[Key, _Entry]]:
        wanted = [*parts[1::2], "", "", ""] if parts[:1] == ["vehicles"] else [""] * 3
        for key, entry in self._entries.items():
            if all(want in ("", str(have)) for want, have in zip(wanted, key, strict=False)):
                yield key, entry


def _iso_time(time_s: float) -> str:
    return datetime.fromtimestamp(time_s, UTC).astimezone().isoformat()


class Subscriber:
    """A client that receives some kinds of message of some systems."""

    def __init__(self, names: Set[str], systems: SystemFilter) -> None:
        self.names = names
        self.systems = systems
        self._waiting: deque[str | bytes] = deque()
        self._bytes = 0
        self._has_waiting = asyncio.Event()

    def push(self, data: str | bytes) -> None:
        """Queue a text or bytes; the oldest entries are dropped to make room."""
        self._waiting.append(data)
        self._bytes += len(data)
        while self._bytes > MAX_WAITING_BYTES:
            self._bytes -= len(self._waiting.popleft())
        self._has_waiting.set()

    async def next(self) -> str | bytes:
        """Return the next entry to send."""
        while not self._waiting:
            self._has_waiting.clear()
            await self._has_waiting.wait()
        data = self._waiting.popleft()
        self._bytes -= len(data)
        return data


def names_matching(pattern: str) -> frozenset[str]:
    """Return the names of messages in which a regular expression is found.

    Raises ValueError with the reason if it is invalid.
    """
    # Counts, and classes of all of Unicode such as \w, take megabytes and a long time to compile.
    if len(pattern) > MAX_PATTERN or not {*"{\\"}.isdisjoint(pattern):
        raise ValueError(f"filter: at most {MAX_PATTERN} letters, without {{}} and \\")
    try:
        wanted = SchemaValidator(core_schema.str_schema(pattern=pattern))
    except SchemaError as error:
        raise ValueError(f"filter {pattern!r}: {str(error).rpartition('error: ')[2]}") from error
    return frozenset(name for name in CLASSES if wanted.isinstance_python(name))


def _with_header(message: Any) -> dict[str, Any]:
    header = {
        "system_id": message.get_srcSystem(),
        "component_id": message.get_srcComponent(),
        "sequence": message.get_seq(),
    }
    return {"header": header, "message": to_json(message)}


def encode(value: Any, line: bytes = b"\n") -> Iterator[bytes]:
    """Encode a value or a part of the tree as indented JSON, entry by entry.

    Scripts rely on the line breaks. `line` is a line break with the indentation of the value.
    """
    if isinstance(value, dict) and any(isinstance(each, dict | _Entry) for each in value.values()):
        before = b"{"
        for name, each in value.items():
            yield before + line + b"  " + msgspec.json.encode(name) + b": "
            yield from encode(each, line + b"  ")
            before = b","
        yield line + b"}"
        return
    plain = value.as_json() if isinstance(value, _Entry) else value
    yield msgspec.json.format(msgspec.json.encode(plain), indent=2).replace(b"\n", line)


def pretty(value: Any) -> str:
    """Return a value as indented JSON."""
    return b"".join(encode(value)).decode()


class RestApi:
    """Answer requests from an uplink's received messages, and send through it."""

    def __init__(self, uplink: Uplink) -> None:
        self._uplink = uplink
        self._book = MessageBook(time.time)
        self._subscribers: list[Subscriber] = []
        self._encoding = asyncio.Lock()
        uplink.listen(self._on_message)

    def routers(self) -> list[APIRouter]:
        """Return the routers to include in an application."""
        service = APIRouter(tags=["service"])
        service.add_api_route("/info", self.info)
        service.add_api_route("/docs", _docs, include_in_schema=False)
        routers = [service]
        for prefix in ("/v1", "", f"{PREFIX}/v1", PREFIX):
            shown = prefix == "/v1"
            routers.append(self._router(prefix, shown=shown))
            if prefix:
                service.add_api_route(f"{prefix}/info", self.info, include_in_schema=False)
        return routers

    async def info(self) -> Response:
        """Return name and version of the program."""
        service = {
            "name": "mavgate",
            "version": __version__,
            "sha": __version__.rpartition("+")[2] or __version__,
            "build_date": "",
            "authors": "",
        }
        return _json({"version": API_VERSION, "service": service})

    async def read_all(self, request: Request) -> Response:
        """Return the newest message of each kind of every system and component.

        `?systems=1,2`, `not-systems=` and `components=` select some.
        """
        return await self.read(request, "")

    async def read(self, request: Request, path: str) -> Response:
        """Return a part of that: `vehicles/1/components/1/messages/ATTITUDE/message/roll`."""
        try:
            systems = selection_from(request.query_params)
            async with self._encoding:
                found = self._book.look_up(path, systems)
                await asyncio.sleep(0)
            return StreamingResponse(encode_in_pieces(found, self._encoding), media_type=JSON)
        except KeyError:
            return Response(NOTHING, media_type=JSON)
        except ValueError as error:
            return Response(str(error), HTTPStatus.BAD_REQUEST, media_type="text/plain")

    async def helper(self, name: str | None = None) -> Response:
        """Return an empty message of a name, to be filled in and sent."""
        if name is None:
            text = "Query deserialize error: missing field `name`"
            return Response(text, HTTPStatus.BAD_REQUEST, media_type="text/plain")
        try:
            message = template(name)
        except ValueError:
            return _json("Invalid message name.", HTTPStatus.NOT_FOUND)
        return _json({"header": DEFAULT_HEADER, "message": message})

    async def write(self, request: Request) -> Response:
        """Send a message, given as `{"header": {...}, "message": {"type": "COMMAND_LONG", ...}}`.

        Its header names the sender: the client's own system and component, such as 255 and 0.
        The text is JSON or JSON5.
        """
        if request.scope[ROLE] is not Role.OPERATOR:
            return Response(NOT_ALLOWED, HTTPStatus.FORBIDDEN)
        try:
            systems = selection_from(request.query_params)
            self._send(_read_json5((await request.body()).decode()), systems)
        except UnicodeDecodeError as error:
            return _refused(f"Failed to parse input as UTF-8 string: {error}")
        except ValueError as error:
            return _refused(NOT_A_MESSAGE, str(error))
        return Response("Ok.", media_type=JSON)

    async def follow(self, socket: WebSocket) -> None:
        """Send messages with names that match a regular expression; accept messages to send.

        `systems`, `not-systems` and `components` select, both of those sent and those accepted;
        `also` names messages without a target to accept too.
        """
        await socket.accept()
        try:
            names = names_matching(socket.query_params.get("filter", EVERYTHING))
            systems = selection_from(socket.query_params)
        except ValueError as error:
            await socket.send_text(pretty({"error": str(error)}))
            await socket.close(WS_INVALID)
            return
        subscriber = Subscriber(names, systems)
        self._subscribers.append(subscriber)
        sending = asyncio.create_task(_send_all(socket, subscriber))
        try:
            await self._read_all(socket, subscriber)
        finally:
            sending.cancel()
            self._subscribers.remove(subscriber)

    def _router(self, prefix: str, *, shown: bool) -> APIRouter:
        router = APIRouter(prefix=prefix, tags=["mavlink"])
        for path, answer, method in (
            ("/mavlink", self.read_all, "GET"),
            ("/mavlink/{path:path}", self.read, "GET"),
            ("/mavlink", self.write, "POST"),
            ("/helper/mavlink", self.helper, "GET"),
        ):
            router.add_api_route(path, answer, methods=[method], include_in_schema=shown)
        router.add_api_websocket_route("/ws/mavlink", self.follow)
        return router

    async def _read_all(self, socket: WebSocket, subscriber: Subscriber) -> None:
        """Handle the messages of an operator; end the connection of a viewer that sends."""
        is_operator = socket.scope[ROLE] is Role.OPERATOR
        with suppress(WebSocketDisconnect):
            while (given := await socket.receive())["type"] == "websocket.receive":
                if not is_operator:
                    await socket.close(WS_1008_POLICY_VIOLATION, NOT_ALLOWED)
                    return
                text = given.get("text")
                subscriber.push(
                    given["bytes"] if text is None else self._answer(text, subscriber.systems)
                )

    def _answer(self, text: str, systems: SystemFilter) -> str:
        try:
            return f"Ok({self._send(_read_json(text), systems)})"
        except ValueError as error:
            return f"Could not convert input message. {error}"

    def _send(self, given: Any, systems: SystemFilter) -> int:
        """Send a message and return its size; raises BadMessageError if it is invalid.

        One that may reach a system that does not pass is invalid too.
        """
        if not isinstance(given, dict):
            raise BadMessageError("it is an object with 'header' and 'message'")
        message = from_json(given.get("message"))
        target = _target(message)
        if systems and not systems.lets_send(message.get_msgId(), target):
            raise BadMessageError(
                f"{message.get_type()} to {target} may reach vehicles that systems= or components= "
                "excludes; also= lets a message without a target pass"
            )
        system_id, component_id = _sender(given.get("header"))
        if self._book.has_heard(system_id, component_id):
            # Ids of a known system must not be used: the gateway would detect a loop.
            system_id = component_id = 0
        size = self._uplink.send(message, system_id, component_id)
        self._book.add(message, is_sent=True)
        return size

    def _on_message(self, message: Any) -> None:
        self._book.add(message)
        origin = message.get_srcSystem(), message.get_srcComponent()
        subscribers = [
            each
            for each in self._subscribers
            if message.msgname in each.names and each.systems.has(origin)
        ]
        if subscribers:
            text = pretty(_with_header(message))
            for subscriber in subscribers:
                subscriber.push(text)


async def _send_all(socket: WebSocket, subscriber: Subscriber) -> None:
    with suppress(WebSocketDisconnect, RuntimeError):
        while True:
            news = await subscriber.next()
            await (socket.send_bytes(news) if isinstance(news, bytes) else socket.send_text(news))


async def _docs() -> FileResponse:
    return FileResponse(DOCS, headers={"content-security-policy": DOCS_POLICY})


def _read_json(text: str) -> Any:
    try:
        return json.loads(text)
    except RecursionError:
        raise BadMessageError("it is nested too deeply") from None
    except ValueError as error:
        raise BadMessageError(str(error)) from None


def _read_json5(text: str) -> Any:
    """Read JSON5; plain JSON, the usual case, is tried first."""
    with suppress(BadMessageError):
        return _read_json(text)
    import pyjson5

    try:
        return pyjson5.decode(text)
    except pyjson5.Json5Exception as error:
        raise BadMessageError(str(error.args[0])) from None


def _refused(text: str, detail: str = "") -> Response:
    """Return mavlink2rest's text, on which its clients rely; the reason is in a header."""
    answer = Response(text, HTTPStatus.NOT_FOUND, media_type=JSON)
    if detail:
        answer.headers["x-error-detail"] = quote(detail, safe=" '\":;,./()[]{}<>|=+*&-_")
    return answer


def _target(message: Any) -> tuple[int, int]:
    """Return the addressed system and component; 0 is all."""
    target = getattr(message, "target_system", getattr(message, "target", 0))
    return target, getattr(message, "target_component", 0)


def _sender(header: Any) -> tuple[int, int]:
    if not isinstance(header, dict):
        raise BadMessageError("'header' is an object with system_id, component_id and sequence")
    ids = [header.get(key, DEFAULT_HEADER[key]) for key in ("system_id", "component_id")]
    for value in ids:
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= MAX_ID:
            raise BadMessageError(f"header: {value!r} is not 0 to {MAX_ID}")
    return ids[0], ids[1]


async def encode_in_pieces(value: Any, turn: asyncio.Lock) -> AsyncIterator[bytes]:
    """Encode a part of the tree piece by piece, since the whole tree may have megabytes.

    Of all answers that share a lock, only one encodes a piece in a turn of the loop.
    """
    parts = encode(value)
    while True:
        piece = b""
        async with turn:
            while len(piece) < PIECE and (part := next(parts, b"")):
                piece += part
            await asyncio.sleep(0)
        if not piece:
            return
        yield piece


def _json(value: Any, status: HTTPStatus = HTTPStatus.OK) -> Response:
    return Response(pretty(value), status, media_type=JSON)
