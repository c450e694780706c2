"""Posts of a phone through the panel to a source of the gateway, past the login by a token."""

import asyncio
import logging
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi import FastAPI

from gateway.live.control_socket import ControlServer
from gateway.live.control_verbs import source_verbs
from gateway.live.source_port import SourcePort
from gateway.panel.access import MAX_BODY, PUSH_HELP, AccessControl
from gateway.panel.logins import MAX_ATTEMPTS, Logins
from gateway.panel.panel_settings import PanelSettings
from gateway.panel.push_api import push_router
from gateway.panel.uplink import ControlClient
from gateway.records import NodeId
from gateway.sources.kinds import make_decoder
from gateway.sources.settings import parse_source
from gateway.sources.source import SourceInput
from tests.panel.web_client import OPERATOR

pytestmark = pytest.mark.io

TOKEN = "a.right~token-16"
PUSH = f"/push/{TOKEN}"


class Gateway:
    """A gateway with a source that takes posts, and a panel that is open to the network."""

    def __init__(self, folder: Path) -> None:
        url, node = parse_source(f"phone:push?token={TOKEN}"), NodeId(1, 8)
        self.source = SourceInput(url, node, make_decoder(url, node))
        self.lines: list[bytes] = []
        hub: Any = None
        port = SourcePort(self.source, lambda _, data: self.lines.append(data), hub)
        self.control = ControlServer(folder / "run.sock", source_verbs([port]))
        settings = PanelSettings(address="0.0.0.0", password=OPERATOR, insecure=True)
        app, logins = FastAPI(), Logins(settings.password, "")
        app.include_router(push_router(ControlClient(self.control.path), logins.may_attempt))
        guard = AccessControl(app, settings, logins)
        transport = httpx.ASGITransport(app=guard)
        self.phone = httpx.AsyncClient(transport=transport, base_url="http://192.168.1.7:14590")


@pytest.fixture
async def gateway(tmp_path: Path) -> AsyncIterator[Gateway]:
    made = Gateway(tmp_path)
    await made.control.start()
    async with made.phone:
        yield made
    made.control.close()


async def test_post_with_the_token_becomes_one_line_of_the_source(gateway: Gateway) -> None:
    content = '{"payload": [\n' + '"\u00e9\u0007", ' * 4000 + "]}"
    answer = await gateway.phone.post(PUSH, content=content.encode())
    assert answer.status_code == 200
    assert b"".join(gateway.lines).decode() == content.replace("\n", " ") + "\n"


async def test_all_but_a_post_with_the_token_gets_a_bare_answer_and_is_not_logged(
    gateway: Gateway, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG, logger="gateway")
    for method, path, status, text in (
        ("POST", "/push/", 404, ""),
        ("POST", f"{PUSH}/x", 404, ""),
        ("PUT", PUSH, 404, ""),
        ("GET", PUSH, 405, PUSH_HELP),
        ("GET", "/push/wrong", 405, PUSH_HELP),
        ("GET", "/push/", 404, ""),
        ("GET", "/push/../push/a/b", 404, ""),
        ("POST", "/", 303, ""),
        ("POST", "/push/wrong", 404, ""),
    ):
        assert gateway.source.report(0).faults == (), "only of a post with a wrong token"
        answer = await gateway.phone.request(method, path, content=b"x" * 9)
        assert (answer.status_code, answer.text) == (status, text), (method, path)
    assert gateway.source.report(0).faults == (("token", 1),)
    assert gateway.lines == []
    assert "push" not in caplog.text


async def test_wrong_tokens_count_as_wrong_passwords_and_do_not_reach_the_gateway(
    gateway: Gateway,
) -> None:
    assert (await gateway.phone.post(PUSH, content=b"x")).status_code == 200
    posts = [gateway.phone.post(f"/push/wrong{n}", content=b"x") for n in range(50)]
    answers = await asyncio.gather(*posts)
    assert sorted(each.status_code for each in answers) == [404] * MAX_ATTEMPTS + [429] * 45
    assert sum(count for _, count in gateway.source.report(0).faults) <= 1
    login = await gateway.phone.post("/login", content=b"password=wrong")
    assert login.status_code == 429
    assert (await gateway.phone.post(PUSH, content=b"x")).status_code == 200


async def pieces() -> AsyncIterator[bytes]:
    for _ in range(2):
        yield b"x" * MAX_BODY


@pytest.mark.parametrize(
    ("headers", "content", "status"),
    [
        ({}, b"x" * (MAX_BODY + 1), 413),
        ({}, pieces(), 413),
        ({"origin": "http://evil.example"}, b"x", 403),
        ({"host": "evil.example"}, b"x", 403),
    ],
    ids=["large", "large of unknown length", "foreign page", "foreign host"],
)
async def test_post_that_is_too_large_or_of_a_foreign_page_is_refused(
    gateway: Gateway, headers: dict[str, str], content: Any, status: int
) -> None:
    answer = await gateway.phone.post(PUSH, content=content, headers=headers)
    assert answer.status_code == status
    assert gateway.lines == []


async def test_token_does_not_open_the_rest_of_the_panel(gateway: Gateway) -> None:
    for path in ("/v1/mavlink", "/push/../v1/mavlink", "/ws/mavlink"):
        assert (await gateway.phone.get(path)).status_code == 401


async def test_post_is_refused_while_no_gateway_runs(gateway: Gateway) -> None:
    gateway.control.close()
    answer = await gateway.phone.post(PUSH, content=b"{}")
    assert (answer.status_code, answer.text) == (404, "")
