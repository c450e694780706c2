"""HTTP posts of phones and other devices to a source of the gateway, by a token in the URL."""

import asyncio
from http import HTTPStatus
from typing import Final

from fastapi import APIRouter, HTTPException, Request

from gateway.live.control_socket import ControlError
from gateway.panel.uplink import ControlClient

PIECE: Final = 10_000
"""Characters of a request to the control socket, of which each becomes six bytes at most."""


def push_router(control: ControlClient) -> APIRouter:
    """Return the router with `/push/{token}`; the content of each post becomes one line."""
    router = APIRouter()
    turn = asyncio.Lock()
    """Pieces of two posts must not be mixed."""

    @router.post("/push/{token}", include_in_schema=False)
    async def push(token: str, request: Request) -> str:
        try:
            # An unknown token is refused before the content is read.
            await control.ask("source.push", token=token, text="")
            content = (await request.body()).replace(b"\n", b" ").decode(errors="replace") + "\n"
            async with turn:
                for at in range(0, len(content), PIECE):
                    await control.ask("source.push", token=token, text=content[at : at + PIECE])
        except ControlError as error:
            raise HTTPException(HTTPStatus.NOT_FOUND, "no source takes this") from error
        return "taken"

    return router
