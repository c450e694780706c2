"""Fixtures that start the gateway and clients, and end them whatever happens."""

import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.end_to_end.processes import Client, Gateway, MavProxy


@pytest.fixture
def start_gateway(tmp_path: Path) -> Iterator[Callable[..., Gateway]]:
    started: list[Gateway] = []

    def start(command: str, *options: str, **more: Any) -> Gateway:
        started.append(Gateway(tmp_path, command, *options, **more))
        return started[-1]

    yield start
    for gateway in started:
        gateway.end(signal.SIGKILL)


@pytest.fixture
def connect() -> Iterator[Callable[..., Client]]:
    clients: list[Client] = []

    def make(port: int = 0) -> Client:
        clients.append(Client(port))
        return clients[-1]

    yield make
    for client in clients:
        client.sock.close()


@pytest.fixture
def start_mavproxy(tmp_path: Path) -> Iterator[Callable[[int], MavProxy]]:
    started: list[MavProxy] = []

    def start(port: int) -> MavProxy:
        started.append(MavProxy(port, tmp_path))
        return started[-1]

    yield start
    for proxy in started:
        proxy.process.kill()
        proxy.process.communicate()
