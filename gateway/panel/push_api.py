"""HTTP posts of phones and other devices to a source of the gateway, by a token in the URL."""

import asyncio
import hmac
import time
from http import HTTPStatus
from typing import Final

from fastapi import APIRouter, HTTPException, Request

from gateway.live.control_socket import ControlError
from gateway.panel.uplink import ControlClient

PIECE: Final = 10_000
"""Maximum characters of a request to the control socket; each becomes at most six bytes."""
ASK_AGAIN_S: Final = 1.0
"""Least interval of reading the gateway's tokens, to which a wrong token is compared again."""


class _Tokens:
    """Cache of the gateway's tokens, so that a flood of wrong ones does not load its event loop."""

    def __init__(self, control: ControlClient) -> None:
        self._control = control
        self._known: list[str] = []
        self._read_s = -ASK_AGAIN_S
        self._reading = asyncio.Lock()

    async def check(self, token: str) -> None:
        """Raise ControlError for a token that is wrong."""
        if self._has(token):
            return
        async with self._reading:
            if time.monotonic() - self._read_s >= ASK_AGAIN_S:
                self._read_s = time.monotonic()
                self._known = [*await self._control.ask("source.tokens")]
                if not self._has(token):
                    # Sent so that the gateway counts the wrong token.
                    await self._control.ask("source.push", token=token, text="")
        if not self._has(token):
            raise ControlError("no source has this token")

    def _has(self, token: str) -> bool:
        return any(hmac.compare_digest(each.encode(), token.encode()) for each in self._known)


def push_router(control: ControlClient) -> APIRouter:
    """Return the router with `/push/{token}`; the content of each post becomes one line."""
    router, tokens = APIRouter(), _Tokens(control)
    turn = asyncio.Lock()
    """Pieces of two posts must not be mixed."""

    @router.post("/push/{token}", include_in_schema=False)
    async def push(token: str, request: Request) -> str:
        try:
            # An unknown token is refused before the content is read.
            await tokens.check(token)
            content = (await request.body()).replace(b"\n", b" ").decode(errors="replace") + "\n"
            async with turn:
                for at in range(0, len(content), PIECE):
                    await control.ask("source.push", token=token, text=content[at : at + PIECE])
        except ControlError as error:
            raise HTTPException(HTTPStatus.NOT_FOUND, "no source takes this") from error
        return "taken"

    return router
