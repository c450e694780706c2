"""Access control of the page: hosts, origins, logins, roles, response headers, and size limits.

Any page that the operator's browser has open may send requests to this one. Two headers that no
page can forge distinguish them: `Host`, which must be a name of ours (against DNS rebinding), and
`Origin`, which must be this page.
"""

import asyncio
import base64
import hashlib
import hmac
import ipaddress
import re
import secrets
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import AbstractAsyncContextManager, asynccontextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import Final
from urllib.parse import SplitResult, parse_qs, urlsplit
from weakref import WeakValueDictionary

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import ClientDisconnect, cookie_parser
from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from gateway.panel.admission import Holder, Places, address_group
from gateway.panel.admission import Role as Role
from gateway.panel.connections import Client
from gateway.panel.panel_settings import LOOPBACK, PanelSettings

COOKIE: Final = "mavgate_panel"
ROLE: Final = "mavgate.role"
"""Key of the scope with the user's role."""
HOLDER: Final = "mavgate.holder"
"""Key of the scope with the `Holder` of what the request opens."""
MAX_BODY: Final = 1 << 20
MAX_LOGIN_BODY: Final = 1 << 13
LOGIN_S: Final = 10.0
"""Longest time for the body of a login request."""
RECORDINGS: Final = "/recordings/"
MAPS: Final = "/maps/"
"""Paths below these two accept whole files."""
API_PATHS: Final = ("/v1/", "/mavlink", "/helper/", "/ws/mavlink", "/info")
"""Paths of the REST and WebSocket API, which pages of `panel.origins` may use."""
CORS_HEADERS: Final = {
    "access-control-allow-credentials": "true",
    "access-control-allow-headers": "content-type",
    "access-control-allow-methods": "GET, POST",
    "access-control-allow-private-network": "true",
    "access-control-expose-headers": "x-error-detail",
    "access-control-max-age": "600",
    "cross-origin-resource-policy": "cross-origin",
    "vary": "Origin",
}
"""Answer to an allowed page of another origin, its preflight request included."""
MAX_DIGITS: Final = 18
"""Of a length; Python reads no number of more than some thousand."""
WS_POLICY_VIOLATION: Final = 1008
LARGE_ANSWERS: Final = re.compile(r"(/mavlink2rest)?(/v1)?/mavlink(/|$)|/path/|/history/")
"""Answers that may have megabytes: one at a time for each session."""
PIECE: Final = 1 << 16
"""Bytes of an answer that are handed to the connection at once."""
WRITE_S: Final = 30.0
"""Longest time until a client has taken a piece; it holds memory for so long."""

COST: Final = 1 << 15
"""scrypt's N with r = 8 and p = 1: 32 MB and some 0.1 s, once a login."""
BLOCK: Final = 8
MEMORY: Final = 64 << 20
SALT_BYTES: Final = 16
SESSION_S: Final = 12 * 3600
SESSIONS_OF_ADDRESS: Final = 16
SESSIONS_OF_ROLE: Final = 32
MAX_ATTEMPTS: Final = 5
"""Attempts of one address within `ATTEMPT_WINDOW_S`; a right password clears them."""
ATTEMPT_WINDOW_S: Final = 60.0
MAX_PEERS: Final = 256
MAX_WAITING: Final = 4
"""Passwords of one network that wait to be hashed."""
MAX_NETWORKS: Final = 16
"""Networks with passwords that wait: an operator waits for one hash of each, some seconds."""
MAX_KNOWN: Final = 64
"""Addresses of successful logins that are remembered."""

NO_SCRIPT_POLICY: Final = (
    "default-src 'none'; style-src 'self'; img-src 'self'; form-action 'self'; base-uri 'none'; "
    "frame-ancestors 'none'"
)
"""Content-Security-Policy of every response that sets none itself: `ScriptNonces`."""
HEADERS: Final = {
    "x-frame-options": "DENY",
    "x-content-type-options": "nosniff",
    "referrer-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": "camera=(), geolocation=(), microphone=(), usb=(), serial=()",
}

LOGIN_PAGE: Final = """<!doctype html><html lang="en"><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1"><title>mavgate</title>
<link rel="stylesheet" href="/web/panel.css">
<body class="login"><form method="post" action="/login">
<h1>mavgate</h1><p role="alert">{word}</p>
<label>Password <input type="password" name="password" autocomplete="current-password" autofocus>
</label><button>Open the panel</button></form></body></html>"""


def hash_password(password: str) -> str:
    """Hash a password for the settings file: `scrypt$N$salt$hash`."""
    salt = secrets.token_bytes(SALT_BYTES)
    return "$".join(("scrypt", str(COST), _text(salt), _text(_derive(password, salt, COST))))


def matches(password: str, hashed: str) -> bool:
    """Return whether a password matches a hash; an invalid hash matches none."""
    try:
        kind, cost, salt, digest = hashed.split("$")
        derived = _derive(password, base64.b64decode(salt), int(cost))
        return kind == "scrypt" and hmac.compare_digest(derived, base64.b64decode(digest))
    except (ValueError, MemoryError):
        return False


class BusyError(Exception):
    """Too many others wait."""


class FairTurns:
    """Let one caller at a time pass; those who wait get their turns by group, one after another."""

    def __init__(self) -> None:
        self._waiting: dict[str, deque[asyncio.Future[None]]] = {}
        self._is_taken = False

    @asynccontextmanager
    async def turn(self, group: str, *, is_known: bool) -> AsyncIterator[None]:
        """Wait for a turn; raises BusyError if too many wait, which a known group never does."""
        if self._is_taken:
            waiting = self._waiting.get(group, ())
            if len(waiting) >= MAX_WAITING or (
                not waiting and not is_known and len(self._waiting) >= MAX_NETWORKS
            ):
                raise BusyError
            turn = asyncio.get_running_loop().create_future()
            self._waiting.setdefault(group, deque()).append(turn)
            try:
                await turn
            except asyncio.CancelledError:
                # Given the turn and cancelled at once: it is passed on.
                if turn.done() and not turn.cancelled():
                    self._pass_on()
                raise
        self._is_taken = True
        try:
            yield
        finally:
            self._pass_on()

    def _pass_on(self) -> None:
        while self._waiting:
            group = next(iter(self._waiting))
            turns = self._waiting.pop(group)
            turn = turns.popleft()
            if turns:
                self._waiting[group] = turns
            if not turn.done():
                turn.set_result(None)
                return
        self._is_taken = False


@dataclass(slots=True)
class Logins:
    """Sessions, and the attempts of each address."""

    operator_hash: str
    viewer_hash: str
    on_close: Callable[[str], object] = lambda _: None
    """Called with the token of a session that has ended, for whatever reason."""
    _sessions: dict[str, tuple[Role, float]] = field(default_factory=dict)
    _places: Places[str] = field(init=False)
    _attempts: dict[str, deque[float]] = field(default_factory=dict)
    _hashing: FairTurns = field(default_factory=FairTurns)
    _known: dict[str, None] = field(default_factory=dict)
    """Addresses from which a login has succeeded, the last one at the end."""

    def __post_init__(self) -> None:
        """Make the places of the sessions."""
        self._places = Places(
            SESSIONS_OF_ROLE, SESSIONS_OF_ADDRESS, SESSIONS_OF_ROLE, self.close_session
        )

    @property
    def is_open(self) -> bool:
        """Whether no password is needed."""
        return not self.operator_hash

    def role_of(self, token: str) -> Role | None:
        """Return the role of a session; None if there is no such session."""
        if self.is_open:
            return Role.OPERATOR
        role, until_s = self._sessions.get(token, (None, 0.0))
        if time.monotonic() < until_s:
            return role
        self.close_session(token)
        return None

    def may_attempt(self, host: str) -> bool:
        """Return whether an address may attempt a login, and count the attempt.

        It is counted before the password is checked, which takes time: parallel attempts must not
        all be checked.
        """
        group, now_s = address_group(host), time.monotonic()
        attempts = self._attempts.get(group)
        if attempts is None:
            if len(self._attempts) >= MAX_PEERS:
                self._attempts.pop(next(iter(self._attempts)))
            attempts = self._attempts[group] = deque(maxlen=MAX_ATTEMPTS)
        if len(attempts) == MAX_ATTEMPTS and now_s - attempts[0] < ATTEMPT_WINDOW_S:
            return False
        attempts.append(now_s)
        return True

    async def check(self, host: str, password: str) -> Role | None:
        """Return the role of a password; one password is hashed at a time, in a thread.

        Networks have turns, and so has each address from which a login has succeeded. Raises
        BusyError if too many wait.
        """
        address = address_group(host)
        is_known = address in self._known or host in LOOPBACK
        async with self._hashing.turn(address if is_known else _network(host), is_known=is_known):
            role = await asyncio.to_thread(self._role_of_password, password)
        if role is not None:
            self._attempts.pop(address, None)
            self._known.pop(address, None)
            self._known[address] = None
            if len(self._known) > MAX_KNOWN:
                del self._known[next(iter(self._known))]
        return role

    def open_session(self, role: Role, host: str) -> str:
        """Open a session and return its token; an older one of the role may end for it."""
        token = secrets.token_urlsafe(32)
        self._places.admit(token, Holder(role, token, address_group(host)))
        self._sessions[token] = (role, time.monotonic() + SESSION_S)
        return token

    def close_session(self, token: str) -> None:
        """End a session."""
        self._places.release(token)
        if self._sessions.pop(token, None) is not None:
            self.on_close(token)

    def _role_of_password(self, password: str) -> Role | None:
        if matches(password, self.operator_hash):
            return Role.OPERATOR
        return Role.VIEWER if matches(password, self.viewer_hash) else None


class _TooLargeError(Exception):
    """A request that is too large."""


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
        self._is_local = settings.address in LOOPBACK
        self._names = {*LOOPBACK, settings.address, *settings.hosts}
        self._secure = bool(settings.certificate)
        self._upload_limit = settings.upload_limit_mb * 1_000_000
        self._origins = frozenset(settings.origins)
        self._sockets: dict[str, set[_SessionSocket]] = {}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        origin = headers.get("origin", "").lower()
        is_allowed = origin in self._origins and scope["path"].startswith(API_PATHS)
        if refusal := self._refusal(headers, is_allowed=is_allowed):
            await _refuse(scope, receive, send, HTTPStatus.FORBIDDEN, refusal)
            return
        if is_allowed and scope["type"] == "http":
            allowed = {"access-control-allow-origin": headers["origin"], **CORS_HEADERS}
            send = _with_headers(send, allowed)
            if scope["method"] == "OPTIONS":
                await Response(status_code=HTTPStatus.NO_CONTENT)(scope, receive, send)
                return
        token = _token(headers)
        role = self._logins.role_of(token)
        if scope["type"] == "http" and scope["path"] in ("/login", "/logout"):
            await self._serve_login(scope, receive, _with_headers(send))
        elif role is not None or scope["path"] == "/web/panel.css":
            client = tuple(scope.get("client") or ("", 0))
            token = "" if self._logins.is_open else token
            scope[ROLE] = role
            scope[HOLDER] = holder = Holder(role, token, address_group(str(client[0])))
            if role is not None:
                self._on_authenticated(client, holder)
            await self._pass_on(scope, receive, send, token)
        elif scope["type"] == "http" and scope["path"] == "/":
            answer = RedirectResponse("/login", HTTPStatus.SEE_OTHER)
            await answer(scope, receive, _with_headers(send))
        else:
            await _refuse(scope, receive, send, HTTPStatus.UNAUTHORIZED, "log in first")

    def _refusal(self, headers: Headers, *, is_allowed: bool) -> str:
        """Return why a request is not from this page or an allowed one; empty if it is."""
        host = headers.get("host", "")
        if not self._is_ours(host):
            return f"this panel is not called {host!r}; settings: panel.hosts"
        if is_allowed:
            return ""
        origin = headers.get("origin")
        if origin is not None and _split(origin).netloc.lower() != host.lower():
            return f"a page of {origin!r} may not use this panel"
        if headers.get("sec-fetch-site") == "cross-site" and headers.get("sec-fetch-mode") not in (
            "navigate",
            None,
        ):
            return "another page may not use this panel"
        return ""

    def _is_ours(self, host: str) -> bool:
        name = _split(f"//{host}").hostname or ""
        if name in self._names:
            return True
        # An IP address cannot be rebound, as a name can.
        return not self._is_local and _is_number(name)

    async def _pass_on(self, scope: Scope, receive: Receive, send: Send, token: str) -> None:
        if scope["type"] == "websocket":
            await self._pass_websocket(scope, receive, send, token)
            return
        if scope.get("method") == "HEAD":
            # Answered as GET; the server, which has the scope itself, leaves the body out.
            scope = {**scope, "method": "GET"}
        limit = self._upload_limit if scope["path"].startswith((RECORDINGS, MAPS)) else MAX_BODY
        answer = PlainTextResponse(
            f"too large: at most {limit} bytes", HTTPStatus.REQUEST_ENTITY_TOO_LARGE
        )
        length = Headers(scope=scope).get("content-length", "").lstrip("0")
        if len(length) > MAX_DIGITS or int(length or 0) > limit:
            await answer(scope, receive, _with_headers(send))
            return
        began, received = False, 0

        async def counted() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            if received > limit:
                raise _TooLargeError
            return message

        async def noted(message: Message) -> None:
            nonlocal began
            began = began or message["type"] == "http.response.start"
            try:
                await _send_in_pieces(send, message)
            except TimeoutError:
                # The rest is dropped, as for a client that has left.
                self._on_stuck(tuple(scope.get("client") or ("", 0)))

        try:
            async with self._turn(scope):
                await _answer(self.app, scope, counted, _with_headers(noted))
        except _TooLargeError:
            if not began:
                await answer(scope, receive, _with_headers(send))

    def _turn(self, scope: Scope) -> AbstractAsyncContextManager[None]:
        """Wait for other large answers to the same session, or connection without one."""
        if scope["method"] != "GET" or not LARGE_ANSWERS.match(scope["path"]):
            return nullcontext()
        key = scope[HOLDER].session or tuple(scope.get("client") or ())
        return self._large.setdefault(key, asyncio.Lock())

    async def _pass_websocket(self, scope: Scope, receive: Receive, send: Send, token: str) -> None:
        """Pass a WebSocket on for as long as its session lasts."""
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
        """End all that a session has opened."""
        self._on_session_end(token)
        for socket in self._sockets.get(token, ()):
            socket.close_soon()

    async def _serve_login(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["method"] == "POST" and scope["path"] == "/logout":
            token = _token(Headers(scope=scope))
            sockets = () if self._logins.is_open else tuple(self._sockets.get(token, ()))
            self._logins.close_session(token)
            for socket in sockets:
                await socket.close()
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
                body = await _small_body(receive)
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
            return {"type": "websocket.disconnect", "code": WS_POLICY_VIOLATION}
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
            await self._send(
                {"type": "websocket.close", "code": WS_POLICY_VIOLATION, "reason": "logged out"}
            )


async def _answer(app: ASGIApp, scope: Scope, receive: Receive, send: Send) -> None:
    """Let a request be answered, unless the browser leaves meanwhile."""
    left = False

    async def heard() -> Message:
        nonlocal left
        message = await receive()
        left = message["type"] == "http.disconnect"
        return message

    try:
        await app(scope, heard, send)
    except ClientDisconnect:
        return
    except RuntimeError:
        # Starlette's middleware misses an answer that nobody waits for any more.
        if not left:
            raise


async def _send_in_pieces(send: Send, message: Message) -> None:
    """Send a part of an answer; raises TimeoutError if the client does not take it.

    The server waits for room between two pieces: of what is not read, only some are in memory.
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


def _with_headers(send: Send, added: Mapping[str, str] = HEADERS) -> Send:
    """Return a `send` that adds headers to a response, by default those for security."""

    async def dressed(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            headers.update(added)
            headers.setdefault("content-security-policy", NO_SCRIPT_POLICY)
        await send(message)

    return dressed


async def _small_body(receive: Receive) -> bytes:
    body = bytearray()
    while True:
        message = await receive()
        if message["type"] == "http.disconnect":
            raise ClientDisconnect
        body += message.get("body", b"")
        if len(body) > MAX_LOGIN_BODY:
            raise _TooLargeError
        if not message.get("more_body"):
            return bytes(body)


async def _refuse(
    scope: Scope, receive: Receive, send: Send, status: HTTPStatus, text: str
) -> None:
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.close", "code": WS_POLICY_VIOLATION, "reason": text[:100]})
    else:
        await PlainTextResponse(text, status)(scope, receive, _with_headers(send))


def _token(headers: Headers) -> str:
    # The browser sends the cookies of all programs of this host, with whatever names they have.
    for value in headers.getlist("cookie"):
        if (token := cookie_parser(value).get(COOKIE)) is not None:
            return token
    return ""


def _split(url: str) -> SplitResult:
    """Return the parts of a URL; none if it is not valid."""
    try:
        parts = urlsplit(url)
        _ = parts.hostname
    except ValueError:
        return urlsplit("")
    return parts


def _network(host: str) -> str:
    """Return the network of an address, /24 or /64, or what else it is."""
    group = address_group(host)
    return group.rpartition(".")[0] or group


def _is_number(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _derive(password: str, salt: bytes, cost: int) -> bytes:
    return hashlib.scrypt(password.encode(), salt=salt, n=cost, r=BLOCK, p=1, maxmem=MEMORY)


def _text(data: bytes) -> str:
    return base64.b64encode(data).decode()


POLICY: Final = (
    "default-src 'none'; script-src 'self' 'nonce-{nonce}' 'unsafe-eval'; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
    "connect-src 'self'; worker-src 'self' blob:; manifest-src 'self'; form-action 'self'; "
    "base-uri 'none'; object-src 'none'; frame-ancestors 'none'"
)
SCRIPT: Final = re.compile(rb"<script(?=[\s>])")


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

        async def dressed(message: Message) -> None:
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

        await self.app(scope, receive, dressed)
