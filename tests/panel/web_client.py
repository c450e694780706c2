"""HTTP clients of an application, without a socket, and hashes of passwords."""

import subprocess
from collections.abc import Callable
from pathlib import Path

import httpx
import pytest
from fastapi import FastAPI
from starlette.types import Receive, Scope, Send

from gateway.panel import logins
from gateway.panel.access import ROLE
from gateway.panel.admission import Role
from gateway.panel.panel_settings import LEAST_COST

with pytest.MonkeyPatch.context() as patch:
    # A hash contains its cost: checking these takes half of the time.
    patch.setattr(logins, "COST", LEAST_COST)
    OPERATOR, VIEWER = logins.hash_password("tower"), logins.hash_password("guest")


def client_of(serve: Callable[[FastAPI], object], role: Role = Role.OPERATOR) -> httpx.AsyncClient:
    """Return a client, logged in with a role, of what a function adds to an application."""
    app = FastAPI()
    serve(app)

    async def with_role(scope: Scope, receive: Receive, send: Send) -> None:
        scope[ROLE] = role
        await app(scope, receive, send)

    transport = httpx.ASGITransport(app=with_role)
    return httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1")


def write_certificate(folder: Path) -> tuple[Path, Path]:
    """Write a certificate of 127.0.0.1, and its key."""
    certificate, key = folder / "panel.pem", folder / "panel.key"
    command = ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256"]
    command += ["-nodes", "-days", "1", "-subj", "/CN=127.0.0.1"]
    command += ["-addext", "subjectAltName=IP:127.0.0.1", "-out", certificate, "-keyout", key]
    subprocess.run(command, check=True, capture_output=True)
    return certificate, key
