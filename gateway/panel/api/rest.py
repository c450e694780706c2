"""MAVLink for scripts and pages: REST and JSON over WebSocket, compatible with mavlink2rest.

All paths exist with and without `/v1` in front, and below `/mavlink2rest`. Viewers may not send.

References
----------
.. [1] https://github.com/mavlink/mavlink2rest, README and `/docs`
"""

import asyncio
import json
import time
from contextlib import suppress
from http import HTTPStatus
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

from fastapi import APIRouter, Request, Response
from starlette.responses import FileResponse
from starlette.websockets import WebSocket, WebSocketDisconnect

from gateway import __version__
from gateway.panel.access import ROLE, WS_POLICY_VIOLATION, Role
from gateway.panel.api.message_book import MessageBook
from gateway.panel.api.stream import EVERYTHING, MessageStream, NameFilters, Subscriber, pretty
from gateway.panel.uplink import Uplink
from gateway.wire.mavlink_json import CLASSES, BadMessageError, from_json, template

API_VERSION: Final = 0
"""Version of the answers' format, as in mavlink2rest."""
DEFAULT_HEADER: Final = {"system_id": 255, "component_id": 0, "sequence": 0}
MAX_ID: Final = 255
NOTHING: Final = "None"
"""Answer for a path without a value."""
NOT_A_MESSAGE: Final = "Failed to parse message, not a valid MAVLinkMessage."
NOT_ALLOWED: Final = "viewers may not send; log in as the operator"
WS_INVALID: Final = 1007
PREFIX: Final = "/mavlink2rest"
"""Prefix under which some clients expect these paths, as BlueOS serves them."""
DOCS: Final = Path(__file__).parent.parent / "web" / "rest.html"
DOCS_POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


class RestApi:
    """Answer requests from an uplink's received messages, and send through it.

    Parameters
    ----------
    uplink : Uplink
        The panel's MAVLink connection.
    """

    def __init__(self, uplink: Uplink) -> None:
        self._uplink = uplink
        self._book = MessageBook(time.time)
        self._stream = MessageStream()
        self._filters: NameFilters | None = None
        uplink.listen(self._take)

    def routers(self) -> list[APIRouter]:
        """Return the routers to include in an application."""
        service = APIRouter(tags=["service"])
        service.add_api_route("/info", self.info)
        for path in ("/v1/info", f"{PREFIX}/info", f"{PREFIX}/v1/info"):
            service.add_api_route(path, self.info, include_in_schema=False)
        service.add_api_route("/docs", _docs, include_in_schema=False)
        prefixes = ("", f"{PREFIX}/v1", PREFIX)
        return [
            service,
            self._router("/v1", shown=True),
            *(self._router(prefix, shown=False) for prefix in prefixes),
        ]

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

    async def read_all(self) -> Response:
        """Return the newest message of each kind of every system and component."""
        return self._read("")

    async def read(self, path: str) -> Response:
        """Return a part of that: `vehicles/1/components/1/messages/ATTITUDE/message/roll`."""
        return self._read(path)

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
            self._send(_read_json5((await request.body()).decode()))
        except UnicodeDecodeError as error:
            return _refused(f"Failed to parse input as UTF-8 string: {error}")
        except ValueError as error:
            return _refused(NOT_A_MESSAGE, str(error))
        return Response("Ok.", media_type="application/json")

    async def follow(self, socket: WebSocket) -> None:
        """Send messages with names that match a regular expression; accept messages to send."""
        await socket.accept()
        if self._filters is None:
            self._filters = NameFilters(CLASSES)
        pattern = socket.query_params.get("filter", EVERYTHING)
        try:
            names = await self._filters.matching(pattern)
        except ValueError as error:
            await socket.send_text(pretty({"error": str(error)}))
            await socket.close(WS_INVALID)
            return
        with self._stream.subscribe(names) as subscriber:
            sending = asyncio.create_task(_send_all(socket, subscriber))
            try:
                await self._read_all(socket, subscriber)
            finally:
                sending.cancel()

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

    def _read(self, path: str) -> Response:
        try:
            return _json(self._book.look_up(path))
        except KeyError:
            return Response(NOTHING, media_type="application/json")

    async def _read_all(self, socket: WebSocket, subscriber: Subscriber) -> None:
        """Carry out what an operator sends; end the connection of a viewer that sends."""
        is_operator = socket.scope[ROLE] is Role.OPERATOR
        with suppress(WebSocketDisconnect):
            while (given := await socket.receive())["type"] == "websocket.receive":
                if not is_operator:
                    await socket.close(WS_POLICY_VIOLATION, NOT_ALLOWED)
                    return
                text = given.get("text")
                subscriber.push(given["bytes"] if text is None else self._answer(text))

    def _answer(self, text: str) -> str:
        try:
            return f"Ok({self._send(_read_json(text))})"
        except ValueError as error:
            return f"Could not convert input message. {error}"

    def _send(self, given: Any) -> int:
        """Send a message and return its size; raises BadMessageError if it is invalid."""
        if not isinstance(given, dict):
            raise BadMessageError("it is an object with 'header' and 'message'")
        message = from_json(given.get("message"))
        system_id, component_id = _sender(given.get("header"))
        if self._book.has_heard(system_id, component_id):
            # Ids of a known system must not be used: the gateway would take that for a loop.
            system_id = component_id = 0
        size = self._uplink.send_as(message, system_id, component_id)
        self._book.take(message, is_sent=True)
        return size

    def _take(self, message: Any) -> None:
        self._book.take(message)
        self._stream.send(message)


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
    answer = Response(text, HTTPStatus.NOT_FOUND, media_type="application/json")
    if detail:
        answer.headers["x-error-detail"] = quote(detail, safe=" '\":;,./()[]{}<>|=+*&-_")
    return answer


def _sender(header: Any) -> tuple[int, int]:
    if not isinstance(header, dict):
        raise BadMessageError("'header' is an object with system_id, component_id and sequence")
    ids = [header.get(key, DEFAULT_HEADER[key]) for key in ("system_id", "component_id")]
    for value in ids:
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= MAX_ID:
            raise BadMessageError(f"header: {value!r} is not 0 to {MAX_ID}")
    return ids[0], ids[1]


def _json(value: Any, status: HTTPStatus = HTTPStatus.OK) -> Response:
    return Response(pretty(value), status, media_type="application/json")
