"""HTTP posts of phones and other devices to a source of the gateway, by a token in the URL."""

import asyncio
import hmac
import time
from collections.abc import Callable
from contextlib import suppress
from http import HTTPStatus
from typing import Final

from fastapi import APIRouter, Request
from starlette.responses import JSONResponse, Response

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

    async def have(self, token: str) -> bool:
        """Return whether a token is one of the gateway's; raises ControlError without a gateway."""
        if self._has(token):
            return True
        async with self._reading:
            if time.monotonic() - self._read_s >= ASK_AGAIN_S:
                self._read_s = time.monotonic()
                self._known = [*await self._control.ask("source.tokens")]
                if not self._has(token):
                    # Sent so that the gateway counts the wrong token, which it refuses.
                    with suppress(ControlError):
                        await self._control.ask("source.push", token=token, text="")
        return self._has(token)

    def _has(self, token: str) -> bool:
        return any(hmac.compare_digest(each.encode(), token.encode()) for each in self._known)


def push_router(control: ControlClient, may_attempt: Callable[[str], bool]) -> APIRouter:
    """Return the router with `/push/{token}`; the content of each post becomes one line.

    `may_attempt` counts a wrong token of an address as a wrong password, and returns False beyond
    the limit.
    """
    router, tokens = APIRouter(), _Tokens(control)
    turn = asyncio.Lock()
    """Pieces of two posts must not be mixed."""

    @router.post("/push/{token}", include_in_schema=False)
    async def push(token: str, request: Request) -> Response:
        try:
            # An unknown token is refused before the content is read. Answers are returned: of an
            # error that is raised, a page would be built, and its path logged.
            if not await tokens.have(token):
                may_go_on = may_attempt(request.client.host if request.client else "")
                refusal = HTTPStatus.NOT_FOUND if may_go_on else HTTPStatus.TOO_MANY_REQUESTS
                return Response(status_code=refusal)
            content = (await request.body()).replace(b"\n", b" ").decode(errors="replace") + "\n"
            async with turn:
                for at in range(0, len(content), PIECE):
                    await control.ask("source.push", token=token, text=content[at : at + PIECE])
        except ControlError:
            return Response(status_code=HTTPStatus.NOT_FOUND)
        return JSONResponse("taken")

    return router
