"""The Content-Security-Policy of pages with scripts, and a nonce for NiceGUI's own ones.

NiceGUI writes inline scripts into its page and compiles templates in the browser, so the policy has
to allow `'unsafe-eval'`. Inline scripts run only with the nonce of their response: a script, an
event handler or a URL that got into the page as markup does not run.
"""

import re
import secrets
from typing import Final

from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

POLICY: Final = (
    "default-src 'none'; script-src 'self' 'nonce-{nonce}' 'unsafe-eval'; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
    "connect-src 'self'; worker-src 'self' blob:; manifest-src 'self'; form-action 'self'; "
    "base-uri 'none'; object-src 'none'; frame-ancestors 'none'"
)
SCRIPT: Final = re.compile(rb"<script(?=[\s>])")


class ScriptNonces:
    """ASGI middleware that gives the scripts of an HTML page a nonce.

    Parameters
    ----------
    app : ASGI application
        Its HTML contains text of others only escaped, as NiceGUI's does.
    """

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
