"""HTTP clients of an application, without a socket."""

from collections.abc import Callable

import httpx
from fastapi import FastAPI
from starlette.types import Receive, Scope, Send

from gateway.panel.access import ROLE
from gateway.panel.admission import Role


def client_of(serve: Callable[[FastAPI], object], role: Role = Role.OPERATOR) -> httpx.AsyncClient:
    """Return a client, logged in with a role, of what a function adds to an application."""
    app = FastAPI()
    serve(app)

    async def with_role(scope: Scope, receive: Receive, send: Send) -> None:
        scope[ROLE] = role
        await app(scope, receive, send)

    return httpx.AsyncClient(
        transport=httpx.ASGITransport(app=with_role), base_url="http://127.0.0.1"
    )
