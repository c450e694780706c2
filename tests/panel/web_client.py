"""HTTP clients of an application, without a socket."""

import httpx
from fastapi import FastAPI
from starlette.types import Receive, Scope, Send

from gateway.panel.access import ROLE
from gateway.panel.admission import Role


def client_as(role: Role, app: FastAPI) -> httpx.AsyncClient:
    """Return a client that has logged in with a role."""

    async def with_role(scope: Scope, receive: Receive, send: Send) -> None:
        scope[ROLE] = role
        await app(scope, receive, send)

    return httpx.AsyncClient(
        transport=httpx.ASGITransport(app=with_role), base_url="http://127.0.0.1"
    )
