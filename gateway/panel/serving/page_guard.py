"""Access control of the page: hosts, origins, logins, and size limits.

Any page that the operator's browser has open may send requests to this one. Two headers that no
page can forge distinguish them: `Host`, which must be a name of ours (against DNS rebinding), and
`Origin`, which must be this page.
"""

import asyncio
import ipaddress
from http import HTTPStatus
from typing import Final
from urllib.parse import SplitResult, parse_qs, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import cookie_parser
from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from gateway.panel.panel_settings import LOOPBACK, PanelSettings
from gateway.panel.serving.page_lock import PageLock

COOKIE: Final = "mavgate_panel"
ROLE: Final = "mavgate.role"
"""Key of the scope with the user's role."""
MAX_BODY: Final = 1 << 20
UPLOAD: Final = "/recordings/"
"""Paths below it accept a whole recording."""
MAX_DIGITS: Final = 18
"""Of a length; Python reads no number of more than some thousand."""
WS_POLICY_VIOLATION: Final = 1008

HEADERS: Final = {
    "x-frame-options": "DENY",
    "x-content-type-options": "nosniff",
    "referrer-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
}

LOGIN_PAGE: Final = """<!doctype html><html lang="en"><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1"><title>mavgate</title>
<link rel="stylesheet" href="/web/panel.css">
<body class="login"><form method="post" action="/login">
<h1>mavgate</h1><p role="alert">{word}</p>
<label>Password <input type="password" name="password" autocomplete="current-password" autofocus>
</label><button>Open the panel</button></form></body></html>"""


class _TooLargeError(Exception):
    """A request that is too large."""


class PageGuard:
    """ASGI middleware in front of the whole page.

    Parameters
    ----------
    app : ASGI application
        The application to protect.
    settings : PanelSettings
        Names, passwords and limits.
    lock : PageLock
        Sessions.
    """

    def __init__(self, app: ASGIApp, settings: PanelSettings, lock: PageLock) -> None:
        self.app = app
        self._lock = lock
        self._is_local = settings.address in LOOPBACK
        self._names = {*LOOPBACK, settings.address, *settings.hosts}
        self._secure = bool(settings.certificate)
        self._upload_limit = settings.upload_limit_mb * 1_000_000

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        if refusal := self._refusal(headers):
            await _refuse(scope, receive, send, HTTPStatus.FORBIDDEN, refusal)
            return
        role = self._lock.role_of(_token(headers))
        if scope["type"] == "http" and scope["path"] in ("/login", "/logout"):
            await self._serve_login(scope, receive, send)
        elif role is not None or scope["path"] == "/web/panel.css":
            scope[ROLE] = role
            if scope.get("method") == "HEAD":
                # Answered as GET; the server, which has the scope itself, leaves the body out.
                scope = {**scope, "method": "GET"}
            await self._pass_on(scope, receive, send)
        elif scope["type"] == "http" and scope["path"] == "/":
            await RedirectResponse("/login", HTTPStatus.SEE_OTHER)(scope, receive, send)
        else:
            await _refuse(scope, receive, send, HTTPStatus.UNAUTHORIZED, "log in first")

    def _refusal(self, headers: Headers) -> str:
        """Return why a request is not from this page; empty if it is."""
        host = headers.get("host", "")
        if not self._is_ours(host):
            return f"this panel is not called {host!r}; settings: panel.hosts"
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

    async def _pass_on(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        limit = self._upload_limit if scope["path"].startswith(UPLOAD) else MAX_BODY
        answer = PlainTextResponse(
            f"too large: at most {limit} bytes", HTTPStatus.REQUEST_ENTITY_TOO_LARGE
        )
        length = Headers(scope=scope).get("content-length", "").lstrip("0")
        if len(length) > MAX_DIGITS or int(length or 0) > limit:
            await answer(scope, receive, send)
            return
        begun, taken = False, 0

        async def counted() -> Message:
            nonlocal taken
            message = await receive()
            taken += len(message.get("body", b""))
            if taken > limit:
                raise _TooLargeError
            return message

        async def dressed(message: Message) -> None:
            nonlocal begun
            if message["type"] == "http.response.start":
                begun = True
                MutableHeaders(scope=message).update(HEADERS)
            await send(message)

        try:
            await _answer(self.app, scope, counted, dressed)
        except _TooLargeError:
            if not begun:
                await answer(scope, receive, send)

    async def _serve_login(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["method"] == "POST" and scope["path"] == "/logout":
            self._lock.close_session(_token(Headers(scope=scope)))
            response: Response = RedirectResponse("/login", HTTPStatus.SEE_OTHER)
            response.delete_cookie(COOKIE)
        elif scope["method"] == "POST":
            response = await self._log_in(scope, receive)
        else:
            response = HTMLResponse(LOGIN_PAGE.format(word=""))
        await response(scope, receive, send)

    async def _log_in(self, scope: Scope, receive: Receive) -> Response:
        peer = str((scope.get("client") or ("",))[0])
        if not self._lock.may_try(peer):
            word = "Too many wrong passwords; wait a minute."
            return HTMLResponse(LOGIN_PAGE.format(word=word), HTTPStatus.TOO_MANY_REQUESTS)
        body = b""
        while True:
            message = await receive()
            body += message.get("body", b"")
            if not message.get("more_body") or len(body) > MAX_BODY:
                break
        password = parse_qs(body.decode(errors="replace")).get("password", [""])[0]
        role = await asyncio.to_thread(self._lock.check, password)
        if role is None:
            self._lock.note_failure(peer)
            word = "That is not the password."
            return HTMLResponse(LOGIN_PAGE.format(word=word), HTTPStatus.UNAUTHORIZED)
        response = RedirectResponse("/", HTTPStatus.SEE_OTHER)
        response.set_cookie(
            COOKIE,
            self._lock.open_session(role),
            httponly=True,
            samesite="strict",
            secure=self._secure,
        )
        return response


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
    except RuntimeError:
        # Starlette's middleware misses an answer that nobody waits for any more.
        if not left:
            raise


async def _refuse(
    scope: Scope, receive: Receive, send: Send, status: HTTPStatus, text: str
) -> None:
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.close", "code": WS_POLICY_VIOLATION, "reason": text[:100]})
    else:
        await PlainTextResponse(text, status)(scope, receive, send)


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


def _is_number(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
