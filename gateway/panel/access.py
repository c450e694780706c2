"""Access control of the page: hosts, origins, roles, size limits, and headers of responses.

Any page that the operator's browser has open may send requests to this one. Two headers that no
page can forge distinguish them: `Host`, which must be a name of ours (against DNS rebinding), and
`Origin`, which must be this page.
"""

import asyncio
import re
import secrets
from collections.abc import Callable, Mapping
from contextlib import AbstractAsyncContextManager, nullcontext, suppress
from http import HTTPStatus
from typing import Final
from urllib.parse import parse_qs
from weakref import WeakValueDictionary

from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.middleware.cors import CORSMiddleware
from starlette.requests import ClientDisconnect, Request, cookie_parser
from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse, Response
from starlette.status import WS_1008_POLICY_VIOLATION
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from gateway.hub.endpoint import host_of, is_loopback, is_numeric
from gateway.panel.admission import Holder, address_group
from gateway.panel.connections import Client
from gateway.panel.logins import BusyError, Logins
from gateway.panel.panel_settings import PanelSettings

COOKIE: Final = "mavgate_panel"
ROLE: Final = "mavgate.role"
"""Key of the scope with the user's role."""
HOLDER: Final = "mavgate.holder"
"""Key of the scope with the `Holder` to which the request belongs."""
MAX_BODY: Final = 1 << 20
MAX_LOGIN_BODY: Final = 1 << 13
LOGIN_S: Final = 10.0
"""Timeout of the body of a login request."""
RECORDINGS: Final = "/recordings/"
MAPS: Final = "/maps/"
"""Prefixes of the paths that accept whole files."""
LOGIN_STYLE: Final = "/web/panel.css"
PUSH: Final = "/push/"
"""Paths without a login: the style sheet of the login page, and posts of devices with a token."""
PUSH_HELP: Final = "A device posts its readings to this address: paste it into the device's app.\n"
API_PATHS: Final = ("/v1/", "/mavlink", "/helper/", "/ws/mavlink", "/info")
"""Paths of the REST and WebSocket API, which pages of `panel.origins` may use."""
MAX_DIGITS: Final = 18
"""Maximum digits of a length; Python refuses numbers of some thousand digits."""
LARGE_ANSWERS: Final = re.compile(r"(/mavlink2rest)?(/v1)?/mavlink(/|$)|/path/|/history/")
"""Paths whose answers may have megabytes: one at a time for each session."""
PIECE: Final = 1 << 16
"""Bytes of an answer that are handed to the connection at once."""
WRITE_S: Final = 30.0
"""Timeout of sending a piece, since a slow client occupies memory."""
NO_SCRIPT_POLICY: Final = (
    "default-src 'none'; style-src 'self'; img-src 'self'; form-action 'self'; base-uri 'none'; "
    "frame-ancestors 'none'"
)
"""Content-Security-Policy of every response without its own one (see `ScriptNonces`)."""
HEADERS: Final = {
    "x-frame-options": "DENY",
    "x-content-type-options": "nosniff",
    "referrer-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": "camera=(), geolocation=(), microphone=(), usb=(), serial=()",
}
POLICY: Final = (
    "default-src 'none'; script-src 'self' 'nonce-{nonce}' 'unsafe-eval'; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
    "connect-src 'self'; worker-src 'self' blob:; manifest-src 'self'; form-action 'self'; "
    "base-uri 'none'; object-src 'none'; frame-ancestors 'none'"
)
SCRIPT: Final = re.compile(rb"<script(?=[\s>])")

LOGIN_PAGE: Final = """<!doctype html><html lang="en"><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1"><title>mavgate</title>
<link rel="stylesheet" href="/web/panel.css">
<body class="login"><form method="post" action="/login">
<h1>mavgate</h1><p role="alert">{word}</p>
<label>Password <input type="password" name="password" autocomplete="current-password" autofocus>
</label><button>Open the panel</button></form></body></html>"""


class _TooLargeError(HTTPException):
    """A request that is too large."""

    def __init__(self, limit: int) -> None:
        super().__init__(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"too large: at most {limit} bytes")


class AccessControl:
    """ASGI middleware in front of the whole page."""

    def __init__(
        self,
        app: ASGIApp,
        settings: PanelSettings,
        logins: Logins,
        on_authenticated: Callable[[Client, Holder], None] = lambda *_: None,
        on_stuck: Callable[[Client], None] = lambda _: None,
        on_session_end: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.app = app
        self._logins = logins
        self._on_authenticated = on_authenticated
        self._on_stuck = on_stuck
        self._on_session_end = on_session_end
        self._large: WeakValueDictionary[object, asyncio.Lock] = WeakValueDictionary()
        logins.on_close = self._end_session
        self._is_local = is_loopback(settings.address)
        self._names = {settings.address, *settings.hosts}
        self._secure = bool(settings.certificate)
        self._upload_limit = settings.upload_limit_mb * 1_000_000
        self._origins = frozenset(settings.origins)
        self._for_origins = CORSMiddleware(
            self._serve,
            settings.origins,
            allow_methods=("GET", "POST"),
            allow_headers=("content-type",),
            allow_credentials=True,
            allow_private_network=True,
            expose_headers=("x-error-detail",),
        )
        self._sockets: dict[str, set[_SessionSocket]] = {}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        is_allowed = headers.get("origin") in self._origins and scope["path"].startswith(API_PATHS)
        if refusal := self._refusal(headers, is_allowed=is_allowed):
            await _refuse(scope, receive, send, HTTPStatus.FORBIDDEN, refusal)
        elif is_allowed and scope["type"] == "http":
            shared = with_headers(send, {"cross-origin-resource-policy": "cross-origin"})
            await self._for_origins(scope, receive, shared)
        else:
            await self._serve(scope, receive, send)

    async def _serve(self, scope: Scope, receive: Receive, send: Send) -> None:
        token = _token(Headers(scope=scope))
        role = self._logins.role_of(token)
        is_push = scope["type"] == "http" and scope["path"].startswith(PUSH)
        if is_push and (answered := _answer_to_push(scope)) is not None:
            await answered(scope, receive, with_headers(send))
        elif scope["type"] == "http" and scope["path"] in ("/login", "/logout"):
            await self._serve_login(scope, receive, with_headers(send))
        elif role is not None or scope["path"] == LOGIN_STYLE or is_push:
            client = tuple(scope.get("client") or ("", 0))
            token = "" if self._logins.is_open else token
            scope[ROLE] = role
            scope[HOLDER] = holder = Holder(role, token, address_group(str(client[0])))
            if role is not None:
                self._on_authenticated(client, holder)
            if scope["type"] == "websocket":
                await self._pass_websocket(scope, receive, send, token)
            else:
                # HEAD too: the server, which has the original scope, omits the body.
                method = "GET" if scope["method"] == "HEAD" else scope["method"]
                await self._pass_request({**scope, "method": method}, receive, send)
        elif scope["type"] == "http" and scope["path"] == "/":
            answer = RedirectResponse("/login", HTTPStatus.SEE_OTHER)
            await answer(scope, receive, with_headers(send))
        else:
            await _refuse(scope, receive, send, HTTPStatus.UNAUTHORIZED, "log in first")

    def _refusal(self, headers: Headers, *, is_allowed: bool) -> str:
        """Return the reason to refuse a request of another page; empty if it is allowed."""
        host = headers.get("host", "")
        if not self._is_ours(host):
            return f"this panel is not called {host!r}; settings: panel.hosts"
        if is_allowed:
            return ""
        origin = headers.get("origin")
        if origin is not None and origin.partition("//")[2].lower() != host.lower():
            return f"a page of {origin!r} may not use this panel"
        if headers.get("sec-fetch-site") == "cross-site" and headers.get("sec-fetch-mode") not in (
            "navigate",
            None,
        ):
            return "another page may not use this panel"
        return ""

    def _is_ours(self, host: str) -> bool:
        name = host_of(host)
        if name in self._names or is_loopback(name):
            return True
        # An IP address, unlike a name, cannot be rebound.
        return not self._is_local and is_numeric(name)

    async def _pass_request(self, scope: Scope, receive: Receive, send: Send) -> None:
        limit = self._upload_limit if scope["path"].startswith((RECORDINGS, MAPS)) else MAX_BODY
        refusal = _TooLargeError(limit)
        answer = PlainTextResponse(refusal.detail, refusal.status_code)
        length = Headers(scope=scope).get("content-length", "").lstrip("0")
        if len(length) > MAX_DIGITS or int(length or 0) > limit:
            await answer(scope, receive, with_headers(send))
            return
        began = has_left = False
        limited = _limited(receive, limit)

        async def received() -> Message:
            nonlocal has_left
            message = await limited()
            has_left = message["type"] == "http.disconnect"
            return message

        async def noted(message: Message) -> None:
            nonlocal began
            began = began or message["type"] == "http.response.start"
            try:
                await _send_in_pieces(send, message)
            except TimeoutError:
                # The rest is dropped, as for a client that has disconnected.
                self._on_stuck(tuple(scope.get("client") or ("", 0)))

        try:
            async with self._turn(scope):
                await self.app(scope, received, with_headers(noted))
        except _TooLargeError:
            if not began:
                await answer(scope, receive, with_headers(send))
        except ClientDisconnect:
            pass
        except RuntimeError:
            # Starlette's middleware raises an error without an answer, which is not due any more
            # after a disconnect.
            if not has_left:
                raise

    def _turn(self, scope: Scope) -> AbstractAsyncContextManager[None]:
        """Wait for other large answers to the session, or to a connection without a session."""
        if scope["method"] != "GET" or not LARGE_ANSWERS.match(scope["path"]):
            return nullcontext()
        key = scope[HOLDER].session or tuple(scope.get("client") or ())
        return self._large.setdefault(key, asyncio.Lock())

    async def _pass_websocket(self, scope: Scope, receive: Receive, send: Send, token: str) -> None:
        socket = _SessionSocket(receive, send, lambda: self._logins.role_of(token) is not None)
        sockets = self._sockets.setdefault(token, set())
        sockets.add(socket)
        try:
            await self.app(scope, socket.receive, socket.send)
        finally:
            sockets.discard(socket)
            if not sockets and self._sockets.get(token) is sockets:
                del self._sockets[token]

    def _end_session(self, token: str) -> None:
        self._on_session_end(token)
        for socket in self._sockets.get(token, ()):
            socket.close_soon()

    async def _serve_login(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["method"] == "POST" and scope["path"] == "/logout":
            self._logins.close_session(_token(Headers(scope=scope)))
            response: Response = RedirectResponse("/login", HTTPStatus.SEE_OTHER)
            response.delete_cookie(COOKIE)
        elif scope["method"] == "POST":
            response = await self._log_in(scope, receive)
        else:
            response = HTMLResponse(LOGIN_PAGE.format(word=""))
        await response(scope, receive, send)

    async def _log_in(self, scope: Scope, receive: Receive) -> Response:
        peer = str((scope.get("client") or ("",))[0])
        try:
            async with asyncio.timeout(LOGIN_S):
                body = await Request(scope, _limited(receive, MAX_LOGIN_BODY)).body()
        except (TimeoutError, _TooLargeError, ClientDisconnect):
            return PlainTextResponse("the request is too large or too slow", HTTPStatus.BAD_REQUEST)
        if not self._logins.may_attempt(peer):
            word = "Too many attempts; wait a minute."
            return HTMLResponse(LOGIN_PAGE.format(word=word), HTTPStatus.TOO_MANY_REQUESTS)
        password = parse_qs(body.decode(errors="replace")).get("password", [""])[0]
        try:
            role = await self._logins.check(peer, password)
        except BusyError:
            word = "Too many attempts of this network; try again in a moment."
            return HTMLResponse(LOGIN_PAGE.format(word=word), HTTPStatus.TOO_MANY_REQUESTS)
        if role is None:
            word = "That is not the password."
            return HTMLResponse(LOGIN_PAGE.format(word=word), HTTPStatus.UNAUTHORIZED)
        response = RedirectResponse("/", HTTPStatus.SEE_OTHER)
        response.set_cookie(
            COOKIE,
            self._logins.open_session(role, peer),
            httponly=True,
            samesite="strict",
            secure=self._secure,
        )
        return response


class _SessionSocket:
    """A WebSocket that ends with the session of its user."""

    def __init__(self, receive: Receive, send: Send, is_valid: Callable[[], bool]) -> None:
        self._receive = receive
        self._send = send
        self._is_valid = is_valid
        self._is_closed = False
        self._closing: asyncio.Future[None] | None = None

    async def receive(self) -> Message:
        """Return the next message; a disconnect once the session has ended."""
        message = await self._receive()
        if message["type"] == "websocket.receive" and (self._is_closed or not self._is_valid()):
            await self.close()
            return {"type": "websocket.disconnect", "code": WS_1008_POLICY_VIOLATION}
        return message

    async def send(self, message: Message) -> None:
        """Send a message unless the session has ended."""
        if self._is_closed:
            return
        if not self._is_valid():
            await self.close()
            return
        self._is_closed = message["type"] == "websocket.close"
        await self._send(message)

    def close_soon(self) -> None:
        """Close the connection in the next turn of the loop."""
        self._closing = asyncio.ensure_future(self.close())

    async def close(self) -> None:
        """Close the connection if it is still open."""
        if self._is_closed:
            return
        self._is_closed = True
        with suppress(OSError, RuntimeError):
            await self._send(_closing("logged out"))


async def _send_in_pieces(send: Send, message: Message) -> None:
    """Send a part of an answer; raises TimeoutError if the client does not read it.

    The server waits for room between two pieces, so that only some unread pieces are in memory.
    """
    body = message.get("body", b"")
    for begin in range(0, len(body) - PIECE, PIECE):
        part = {**message, "body": body[begin : begin + PIECE], "more_body": True}
        async with asyncio.timeout(WRITE_S):
            await send(part)
    if len(body) > PIECE:
        message = {**message, "body": body[(len(body) - 1) // PIECE * PIECE :]}
    async with asyncio.timeout(WRITE_S):
        await send(message)


def _answer_to_push(scope: Scope) -> Response | None:
    """Return the answer to a request below `/push/`, whose path is a secret; None for a post."""
    token = scope["path"].removeprefix(PUSH)
    is_token = token and "/" not in token
    if is_token and scope["method"] == "POST":
        return None
    if is_token and scope["method"] in ("GET", "HEAD"):
        # The camera of a phone opens the address in the QR code.
        return PlainTextResponse(PUSH_HELP, HTTPStatus.METHOD_NOT_ALLOWED, {"allow": "POST"})
    return Response(status_code=HTTPStatus.NOT_FOUND)


def _limited(receive: Receive, limit: int) -> Receive:
    """Return a `receive` that raises `_TooLargeError` beyond a limit of bytes."""
    received = 0

    async def counted() -> Message:
        nonlocal received
        message = await receive()
        received += len(message.get("body", b""))
        if received > limit:
            raise _TooLargeError(limit)
        return message

    return counted


async def _refuse(
    scope: Scope, receive: Receive, send: Send, status: HTTPStatus, text: str
) -> None:
    if scope["type"] == "websocket":
        await receive()
        await send(_closing(text[:100]))
    else:
        await PlainTextResponse(text, status)(scope, receive, with_headers(send))


def _closing(reason: str) -> Message:
    return {"type": "websocket.close", "code": WS_1008_POLICY_VIOLATION, "reason": reason}


def _token(headers: Headers) -> str:
    # The browser sends the cookies of all programs on this host, which may have any names.
    for value in headers.getlist("cookie"):
        if (token := cookie_parser(value).get(COOKIE)) is not None:
            return token
    return ""


def with_headers(send: Send, added: Mapping[str, str] = HEADERS) -> Send:
    """Return a `send` that adds headers to a response, by default those for security."""

    async def with_added(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            headers.update(added)
            headers.setdefault("content-security-policy", NO_SCRIPT_POLICY)
        await send(message)

    return with_added


class ScriptNonces:
    """ASGI middleware that gives the scripts of an HTML page a nonce."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, with the policy."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        nonce = secrets.token_urlsafe(16)
        begin: Message | None = None
        body = b""

        async def with_added(message: Message) -> None:
            nonlocal begin, body
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                if headers.get("content-type", "").startswith("text/html"):
                    begin = message
                    return
            if begin is None:
                await send(message)
                return
            body += message.get("body", b"")
            if message.get("more_body"):
                return
            body = SCRIPT.sub(b'<script nonce="' + nonce.encode() + b'"', body)
            headers = MutableHeaders(scope=begin)
            headers["content-length"] = str(len(body))
            headers["content-security-policy"] = POLICY.format(nonce=nonce)
            await send(begin)
            await send({"type": "http.response.body", "body": body})

        await self.app(scope, receive, with_added)
