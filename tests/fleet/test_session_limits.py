"""Bounds of a fleet's session: who may connect, and how much a hostile site can send."""

import logging
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest
import zenoh

from gateway.fleet import session as fleet_session
from gateway.fleet.server import MAX_SESSIONS, FleetServer
from gateway.fleet.session import (
    MAX_ANSWER,
    NoAnswerError,
    QueryRefusedError,
    missing_authentication,
)
from gateway.fleet.settings import FleetSettings
from gateway.hub.settings import HubSettings
from tests.fleet.conftest import World, announce
from tests.ports import free_port

MUTUAL = {"enable_mtls": "true", "root_ca_certificate": '"/ca.pem"'}
ONE_WAY = {"listen_certificate": '"/router.pem"', "listen_private_key": '"/router.key"'}


def configured(tls: dict[str, str] | None = None, users: str = "") -> zenoh.Config:
    config = zenoh.Config()
    for name, value in (tls or {}).items():
        config.insert_json5(f"transport/link/tls/{name}", value)
    if users:
        config.insert_json5("transport/auth/usrpwd/dictionary_file", f'"{users}"')
    return config


@pytest.mark.parametrize(
    ("locator", "tls", "users", "is_safe"),
    [
        ("tcp/127.0.0.1:7447", {}, "", True),
        ("tcp/[::1]:7447", {}, "", True),
        ("tcp/localhost:7447", {}, "", True),
        ("unixsock-stream//run/zenoh", {}, "", True),
        ("tcp/0.0.0.0:7447", {}, "", False),
        ("tcp/[::]:7447", {}, "", False),
        ("tcp/192.168.1.5:7447#iface=eth0", {}, "", False),
        ("tcp/localhost.example:7447", {}, "", False),
        ("ws/0.0.0.0:7447", {}, "", False),
        ("tls/0.0.0.0:7447", ONE_WAY, "", False),
        ("tls/0.0.0.0:7447", {"enable_mtls": "true"}, "", False),
        ("tls/0.0.0.0:7447", {**MUTUAL, "enable_mtls": "false"}, "", False),
        ("tcp/0.0.0.0:7447", MUTUAL, "", False),
        ("tls/0.0.0.0:7447", MUTUAL, "", True),
        ("quic/0.0.0.0:7447", MUTUAL, "", True),
        ("tcp/0.0.0.0:7447", {}, "/users", True),
    ],
)
def test_router_beyond_loopback_needs_certificates_or_users(
    locator: str, tls: dict[str, str], users: str, is_safe: bool
) -> None:
    assert (missing_authentication(locator, configured(tls, users)) == "") == is_safe


def test_fleet_refuses_to_listen_beyond_loopback_without_authentication(tmp_path: Path) -> None:
    settings = FleetSettings(listen="tcp/0.0.0.0:7447", ids_file=str(tmp_path / "ids.json"))
    with pytest.raises(ValueError, match=r"enable_mtls.*docs/fleet.md.*insecure = true"):
        FleetServer(settings, HubSettings())


async def test_insecure_fleet_warns_at_every_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    # No other machine can reach it, but it is not written as an address of loopback.
    listen, file = f"tcp/127.1:{free_port()}", str(tmp_path / "ids.json")
    settings = FleetSettings(listen=listen, insecure=True, ids_file=file)
    for _ in range(2):
        fleet = FleetServer(settings, HubSettings(endpoints=()))
        caplog.clear()
        await fleet.start()
        fleet.close()
        assert "insecure: tcp/127.1" in caplog.text
        assert caplog.records[0].levelno == logging.WARNING


def reply(site: str, payload: bytes | int, *, is_error: bool = False) -> Any:
    """A reply; an integer stands for a payload of that size which must not be read."""
    data = MagicMock()
    if isinstance(payload, bytes):
        data.to_bytes.return_value = payload
        data.__len__.return_value = len(payload)
    else:
        data.to_bytes.side_effect = AssertionError("too large to be read")
        data.__len__.return_value = payload
    sample = MagicMock(payload=data, key_expr=f"mavlink/{site}/recordings")
    return MagicMock(ok=None if is_error else sample, err=sample if is_error else None)


def query(*replies: Any) -> dict[str, bytes]:
    session = MagicMock()
    session.get.return_value = iter(replies)
    return fleet_session._query(session, "key", b"", 1.0)


def test_first_answer_of_each_site_is_used() -> None:
    found = query(reply("a", b"1"), reply("b", b"2"), reply("a", b"3"))
    assert found == {"a": b"1", "b": b"2"}


def test_answer_above_the_limit_is_ignored_unread() -> None:
    assert query(reply("a", 1 << 30), reply("b", b"2")) == {"b": b"2"}
    with pytest.raises(QueryRefusedError, match=str(MAX_ANSWER)):
        query(reply("a", MAX_ANSWER + 1))


@pytest.mark.parametrize("payload", [b"x" * 1000, b""])
def test_endless_answers_are_cut_off(monkeypatch: pytest.MonkeyPatch, payload: bytes) -> None:
    monkeypatch.setattr(fleet_session, "MAX_ANSWERS", 10_000)

    def endless() -> Any:
        number = 0
        while True:
            number += 1
            yield reply(f"site-{number}", payload, is_error=not payload)

    session = MagicMock()
    session.get.return_value = endless()
    try:
        found = fleet_session._query(session, "key", b"", 1.0)
        assert sum(map(len, found.values())) <= 10_000
    except NoAnswerError:
        assert not payload


async def test_forged_sessions_and_keys_of_a_site_are_bounded(world: World, forger: Any) -> None:
    tokens = [announce(forger, "field-a", f"session-{number}") for number in range(100)]
    tokens.append(announce(forger, "field-last"))
    await world.until(lambda: "field-last" in world.shown())
    assert world.shown()["field-a"]["sessions"] == MAX_SESSIONS
    forger.put(f"mavlink/field-{'a' * 60_000}/1/out", b"x")
    await world.until(lambda: world.fleet.status()["bad_names"])
    for token in tokens:
        token.undeclare()
