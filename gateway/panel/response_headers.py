"""Response headers for security, and the policy for the scripts of a page."""

import re
import secrets
from collections.abc import Mapping
from typing import Final

from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

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
