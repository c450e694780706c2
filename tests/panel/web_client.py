"""HTTP clients of an application, without a socket, and hashes of passwords."""

import subprocess
from collections.abc import Callable
from pathlib import Path

import httpx
from fastapi import FastAPI
from starlette.types import Receive, Scope, Send

from gateway.panel.access import ROLE
from gateway.panel.admission import Role

OPERATOR = (
    "scrypt$16384$6Gty0H0vHneGTO2S7azMDQ==$iiC0+hQH4sjVNjJatPWodxe2NbV/Fi9BXA3cxE57o6fn9SorAf3isZ/h"
    "F4bDm2vFKiVSAQV37v3tjzesv0oReA=="
)
VIEWER = (
    "scrypt$16384$SH6f7l4chnSfqtlBYZFqtA==$xJF6gX66vfuLuWuseaDQ3s3NvqjB7UMbX1OouRVfGCiwNf/+g1J2mWP9"
    "mZx4tw39SW/xQrLtW3dPwKJTQQ2Jmw=="
)
"""Hashes of the passwords "tower" and "guest", of the least cost."""


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
