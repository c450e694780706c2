"""Access control of the page, in front of an application that accepts every request."""

import asyncio
import base64
import contextlib
import logging
import re
import subprocess
import threading
from collections import Counter
from collections.abc import AsyncIterator
from http import HTTPStatus
from pathlib import Path
from typing import Any

import httpx
import pytest
from starlette.middleware.base import BaseHTTPMiddleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, PlainTextResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from gateway.panel import access, logins
from gateway.panel.access import (
    COOKIE,
    HEADERS,
    MAX_BODY,
    MAX_LOGIN_BODY,
    ROLE,
    AccessControl,
    ScriptNonces,
)
from gateway.panel.logins import MAX_ATTEMPTS, Logins, hash_password, matches
from gateway.panel.panel_server import PageErrors, PanelError, tls_files, without_traceback
from gateway.panel.panel_settings import PanelSettings
from tests.conftest import ManualClock
from tests.panel.web_client import OPERATOR, VIEWER, write_certificate

HERE = "http://127.0.0.1:14590"


async def grants_all(scope: Scope, receive: Receive, send: Send) -> None:
    body = await Request(scope, receive).body()
    answer = PlainTextResponse(f"{scope[ROLE]} {len(body)}", headers={"x-method": scope["method"]})
    await answer(scope, receive, send)


def guarded(
    settings: PanelSettings | None = None, app: ASGIApp = grants_all, **options: Any
) -> AccessControl:
    settings = settings or PanelSettings()
    lock = Logins(settings.password, settings.viewer_password)
    return AccessControl(app, settings, lock, **options)


def client_of(guard: ASGIApp, base: str = HERE) -> httpx.AsyncClient:
    return httpx.AsyncClient(transport=httpx.ASGITransport(app=guard), base_url=base)


def get_scope(path: str, port: int = 1) -> Scope:
    headers = [(b"host", b"127.0.0.1")]
    client = ("10.0.0.1", port)
    return {"type": "http", "method": "GET", "path": path, "headers": headers, "client": client}


async def sent_by(
    app: ASGIApp, scope: Scope, received: str = "http.request", on_send: Any = None
) -> list[str]:
    """Pass a request and what is received; return the types of the messages that are sent."""
    sent: list[str] = []

    async def receive() -> Message:
        return {"type": received}

    async def send(message: Message) -> None:
        sent.append(message["type"])
        if on_send is not None:
            await on_send(message)

    await app(scope, receive, send)
    return sent


def network_client(**settings: Any) -> httpx.AsyncClient:
    """Return a client of a panel that is open to the network."""
    opened = PanelSettings(address="0.0.0.0", password=OPERATOR, insecure=True, **settings)
    return client_of(guarded(opened), "http://192.168.1.7:14590")


@pytest.fixture
async def locked() -> AsyncIterator[httpx.AsyncClient]:
    async with network_client(viewer_password=VIEWER) as client:
        yield client


@pytest.mark.parametrize(
    ("name", "value", "status"),
    [
        *(("host", each, HTTPStatus.OK) for each in ("127.0.0.1:14590", "localhost:14590")),
        *(("host", each, HTTPStatus.OK) for each in ("[::1]:14590", "ground.local:14590")),
        ("origin", HERE, HTTPStatus.OK),
        *(("host", f"evil.example{port}", HTTPStatus.FORBIDDEN) for port in ("", ":14590")),
        *(("host", each, HTTPStatus.FORBIDDEN) for each in ("10.0.0.7:14590", "", "[::1", "[x]")),
        *(("origin", f"http://{each}", HTTPStatus.FORBIDDEN) for each in ("evil.example", "[::1")),
        *(("origin", each, HTTPStatus.FORBIDDEN) for each in ("null", "http://127.0.0.1:8080")),
    ],
)
async def test_foreign_host_and_origin_are_refused(
    name: str, value: str, status: HTTPStatus
) -> None:
    async with client_of(guarded(PanelSettings(hosts=("ground.local",)))) as client:
        for method in ("GET", "POST"):
            answer = await client.request(method, "/", headers={name: value})
            assert answer.status_code == status
    assert (answer.text == "operator 0") == (status == HTTPStatus.OK)
    assert answer.headers["x-frame-options"] == "DENY"


async def test_head_is_answered_as_get() -> None:
    """Its body is left out by the server in front of the guard."""
    async with client_of(guarded()) as client:
        answer = await client.head("/")
    assert answer.headers["x-method"] == "GET"


async def says_nothing(scope: Scope, receive: Receive, send: Send) -> None:
    await receive()


async def reads_all(scope: Scope, receive: Receive, send: Send) -> None:
    await Request(scope, receive).body()


PASSED_ON = BaseHTTPMiddleware(says_nothing, lambda request, call_next: call_next(request))


@pytest.mark.parametrize(
    ("app", "method", "received", "is_error"),
    [
        (PASSED_ON, "GET", "http.disconnect", False),
        (PASSED_ON, "GET", "http.request", True),
        (reads_all, "PUT", "http.disconnect", False),
    ],
    ids=["client left", "no answer", "interrupted upload"],
)
async def test_early_disconnect_is_no_error(
    app: ASGIApp, method: str, received: str, is_error: bool
) -> None:
    scope = get_scope("/recordings/a") | {"method": method}
    with pytest.raises(RuntimeError) if is_error else contextlib.nullcontext():
        assert await sent_by(guarded(app=app), scope, received) == []


FOREIGN = "http://cockpit.example:8080"
ALLOWED = PanelSettings(origins=(FOREIGN,))


@pytest.mark.parametrize(
    ("path", "origin", "is_allowed"),
    [
        ("/v1/mavlink", FOREIGN, True),
        ("/mavlink2rest/mavlink", FOREIGN, True),
        ("/", FOREIGN, False),
        ("/recordings/x", FOREIGN, False),
        ("/v1/mavlink", "http://cockpit.example", False),
        ("/v1/mavlink", "null", False),
    ],
)
async def test_listed_origin_may_use_the_api_only(path: str, origin: str, is_allowed: bool) -> None:
    headers = {"origin": origin, "sec-fetch-site": "cross-site", "sec-fetch-mode": "cors"}
    async with client_of(guarded(ALLOWED)) as client:
        answer = await client.post(path, headers=headers)
        asked = headers | {"access-control-request-method": "POST"}
        preflight = await client.options(path, headers=asked)
    statuses = (HTTPStatus.OK, HTTPStatus.OK) if is_allowed else (HTTPStatus.FORBIDDEN,) * 2
    assert (answer.status_code, preflight.status_code) == statuses
    found = [answer.headers.get(f"access-control-allow-{key}") for key in ("origin", "credentials")]
    assert found == ([origin, "true"] if is_allowed else [None, None])
    allowed = preflight.headers.get("access-control-allow-headers", "")
    assert ("content-type" in allowed.lower()) == is_allowed


@pytest.mark.parametrize(
    ("settings", "path", "host", "origin", "is_accepted"),
    [
        (PanelSettings(), "/telemetry", "127.0.0.1:14590", HERE, True),
        (PanelSettings(), "/telemetry", "127.0.0.1:14590", "http://evil.example", False),
        (PanelSettings(), "/telemetry", "evil.example", HERE, False),
        (PanelSettings(password=OPERATOR), "/telemetry", "127.0.0.1:14590", HERE, False),
        (ALLOWED, "/v1/ws/mavlink", "127.0.0.1:14590", FOREIGN, True),
        (ALLOWED, "/v1/ws/mavlink", "evil.example", FOREIGN, False),
    ],
    ids=["page", "foreign page", "foreign host", "no login", "listed", "listed at foreign host"],
)
async def test_websocket_needs_host_origin_and_password(
    settings: PanelSettings, path: str, host: str, origin: str, is_accepted: bool
) -> None:
    async def accept(scope: Scope, receive: Receive, send: Send) -> None:
        await send({"type": "websocket.accept"})

    headers = [(b"host", host.encode()), (b"origin", origin.encode())]
    scope = get_scope(path) | {"type": "websocket", "headers": headers}
    sent = await sent_by(guarded(settings, accept), scope, "websocket.connect")
    assert sent[0] == ("websocket.accept" if is_accepted else "websocket.close")


async def test_listed_origin_needs_the_login_too() -> None:
    async with network_client(origins=(FOREIGN,)) as client:
        answer = await client.get("/v1/mavlink", headers={"origin": FOREIGN})
    assert answer.status_code == HTTPStatus.UNAUTHORIZED


@pytest.mark.parametrize(
    "origin", ["*", "null", "example.org", "https://example.org/page", "https://Example.org"]
)
def test_origin_that_no_browser_sends_is_refused(origin: str) -> None:
    with pytest.raises(ValueError, match=r"https://example\.org:8080"):
        PanelSettings(origins=(origin,))


async def in_pieces(size: int) -> AsyncIterator[bytes]:
    for _ in range(20):
        yield bytes(size // 20)


@pytest.mark.parametrize(
    ("content", "headers", "is_refused"),
    [
        (bytes(MAX_BODY), {}, False),
        (bytes(MAX_BODY + 1), {}, True),
        (in_pieces(2 * MAX_BODY), {}, True),
        (b"", {"content-length": "9" * 5000}, True),
    ],
    ids=["fitting", "large", "of unknown length", "of endless length"],
)
async def test_large_body_is_refused_with_and_without_a_declared_length(
    content: Any, headers: dict[str, str], is_refused: bool
) -> None:
    async with client_of(guarded()) as client:
        answer = await client.post("/x", content=content, headers=headers)
    assert (answer.status_code == HTTPStatus.REQUEST_ENTITY_TOO_LARGE) == is_refused
    assert (answer.text == f"operator {MAX_BODY}") != is_refused


@pytest.mark.parametrize("path", ["/recordings/x", "/maps/x"])
async def test_uploads_have_a_limit_of_their_own(path: str) -> None:
    async with client_of(guarded(PanelSettings(upload_limit_mb=2))) as client:
        fitting = await client.put(path, content=bytes(2_000_000))
        too_large = await client.put(path, content=bytes(2_000_001))
    assert fitting.text == "operator 2000000"
    assert too_large.status_code == HTTPStatus.REQUEST_ENTITY_TOO_LARGE


async def test_request_without_a_session_is_refused(locked: httpx.AsyncClient) -> None:
    assert (await locked.get("/")).headers["location"] == "/login"
    assert (await locked.get("/path/1")).status_code == HTTPStatus.UNAUTHORIZED
    locked.cookies.set(COOKIE, "forged")
    assert (await locked.get("/path/1")).status_code == HTTPStatus.UNAUTHORIZED


@pytest.mark.parametrize(("password", "role"), [("tower", "operator"), ("guest", "viewer")])
async def test_password_sets_the_role(locked: httpx.AsyncClient, password: str, role: str) -> None:
    answer = await locked.post("/login", data={"password": password})
    assert answer.status_code == HTTPStatus.SEE_OTHER
    assert "HttpOnly" in answer.headers["set-cookie"]
    assert "SameSite=strict" in answer.headers["set-cookie"]
    assert (await locked.get("/")).text.startswith(role)
    await locked.post("/logout")
    assert (await locked.get("/")).headers["location"] == "/login"


async def test_cookies_of_other_programs_are_ignored(locked: httpx.AsyncClient) -> None:
    """A browser sends those of every port of the host, and their names may be odd."""
    await locked.post("/login", data={"password": "tower"})
    token = locked.cookies[COOKIE]
    locked.cookies.clear()
    answer = await locked.get("/", headers={"cookie": f"a/b=c; {{d}}=e; {COOKIE}={token}"})
    assert (answer.status_code, answer.text) == (HTTPStatus.OK, "operator 0")


async def test_parallel_logins_of_an_address_are_limited_and_hashed_one_at_a_time(
    locked: httpx.AsyncClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    hashed: set[str] = set()
    hashing = threading.Lock()

    def slow(password: str, _: str) -> bool:
        assert hashing.acquire(blocking=False)
        threading.Event().wait(0.01)
        hashed.add(password)
        hashing.release()
        return False

    monkeypatch.setattr(logins, "matches", slow)
    posts = [locked.post("/login", data={"password": f"guess {n}"}) for n in range(100)]
    answers = await asyncio.gather(*posts)
    assert Counter(answer.status_code for answer in answers) == {
        HTTPStatus.UNAUTHORIZED: MAX_ATTEMPTS,
        HTTPStatus.TOO_MANY_REQUESTS: 100 - MAX_ATTEMPTS,
    }
    assert len(hashed) == MAX_ATTEMPTS
    answer = await locked.post("/login", data={"password": "tower"})
    assert answer.status_code == HTTPStatus.TOO_MANY_REQUESTS


async def test_correct_password_clears_the_attempts(locked: httpx.AsyncClient) -> None:
    for _ in range(2):
        for _ in range(MAX_ATTEMPTS - 1):
            await locked.post("/login", data={"password": "guess"})
        answer = await locked.post("/login", data={"password": "tower"})
        assert answer.status_code == HTTPStatus.SEE_OTHER


async def test_login_body_is_limited(locked: httpx.AsyncClient) -> None:
    answer = await locked.post("/login", content=b"password=" + b"x" * MAX_LOGIN_BODY)
    assert answer.status_code == HTTPStatus.BAD_REQUEST


@pytest.mark.parametrize("path", ["/", "/login", "/logout", "/path/1", "/web/panel.css", "/x"])
@pytest.mark.parametrize("host", ["192.168.1.7:14590", "evil.example"])
async def test_responses_have_security_headers(
    locked: httpx.AsyncClient, path: str, host: str
) -> None:
    answer = await locked.get(path, headers={"host": host})
    assert {name: answer.headers[name] for name in HEADERS} == HEADERS
    assert "frame-ancestors 'none'" in answer.headers["content-security-policy"]
    assert "script-src" not in answer.headers["content-security-policy"]


async def test_inline_scripts_of_a_page_get_the_nonce_of_their_response() -> None:
    page = b"<script>one()</script><p>&lt;script&gt;</p><script src=/x defer></script><scripts>"
    seen = set()
    for _ in range(2):
        async with client_of(ScriptNonces(HTMLResponse(page))) as client:
            answer = await client.get("/")
        policy = answer.headers["content-security-policy"]
        nonce = re.search(r"'nonce-([\w-]{22})'", policy)
        assert nonce is not None
        seen.add(nonce[1])
        assert answer.text.count(f'<script nonce="{nonce[1]}"') == 2
        assert answer.text.endswith("<scripts>")
        assert "'unsafe-inline'" not in policy.partition("script-src")[2].partition(";")[0]
    assert len(seen) == 2


def test_hash_matches_only_its_password() -> None:
    assert matches("tower", OPERATOR)
    assert not matches("Tower", OPERATOR)
    assert hash_password("tower") != OPERATOR
    other_kind = f"md5{OPERATOR.removeprefix('scrypt')}"
    for broken in ("", "scrypt$", "scrypt$x$y$z", "scrypt$7$AAAA$AAAA", other_kind):
        assert not matches("tower", broken)


@pytest.mark.parametrize(
    ("settings", "missing"),
    [
        ({"address": "0.0.0.0"}, "password"),
        ({"address": "192.168.1.7", "password": OPERATOR}, "certificate"),
        ({"address": "::", "insecure": True}, "password"),
        ({"certificate_key": "panel.key"}, "certificate"),
    ],
    ids=["open", "without TLS", "insecure without password", "key alone"],
)
def test_network_needs_password_and_certificate(settings: dict[str, object], missing: str) -> None:
    with pytest.raises(ValueError, match=missing):
        PanelSettings(**settings)


@pytest.mark.io
@pytest.mark.parametrize(
    ("certificate", "key", "message"),
    [
        ("gone.pem", "here.pem", r"^\S*gone.pem: No such file"),
        ("here.pem", "gone.pem", r"^\S*gone.pem: No such file"),
        ("here.pem", "", r"here.pem and \S*here.pem must be a certificate and its key"),
    ],
)
def test_bad_certificate_is_named(tmp_path: Path, certificate: str, key: str, message: str) -> None:
    (tmp_path / "here.pem").write_text("junk")
    files = {"certificate": tmp_path / certificate}
    files |= {"certificate_key": tmp_path / key} if key else {}
    with pytest.raises(PanelError, match=message):
        tls_files(PanelSettings(**{name: str(file) for name, file in files.items()}))


@pytest.mark.io
def test_key_in_the_certificate_file_is_accepted_unless_encrypted(tmp_path: Path) -> None:
    (certificate, key), locked = write_certificate(tmp_path), tmp_path / "locked"
    words = ["ec", "-in", key, "-aes256", "-passout", "pass:secret", "-out", locked]
    subprocess.run(["openssl", *words], check=True, capture_output=True)
    settings = PanelSettings(certificate=str(certificate), certificate_key=str(locked))
    with pytest.raises(PanelError, match=r"without a password$"):
        tls_files(settings)
    certificate.write_text(certificate.read_text() + key.read_text())
    assert tls_files(PanelSettings(certificate=str(certificate))) == (certificate, certificate)


@pytest.mark.parametrize(
    ("error", "is_kept"),
    [(UnicodeDecodeError("utf-8", b"\xff", 0, 1, "no text"), False), (OSError("another"), True)],
    ids=["invalid text", "another error"],
)
def test_request_with_invalid_text_is_one_line_in_the_log(error: Exception, is_kept: bool) -> None:
    cause = (type(error), error, None)
    record = logging.LogRecord("uvicorn.error", logging.ERROR, "", 0, "Invalid", (), cause)
    assert without_traceback(record)
    assert (record.exc_info is not None) == is_kept


def test_failed_events_of_pages_are_a_few_lines_without_a_traceback(
    caplog: pytest.LogCaptureFixture, clock: ManualClock
) -> None:
    logger = logging.getLogger("tests.pages")
    logger.addFilter(PageErrors(clock))
    for number in range(40):
        clock.now_us = 100_000_000 + number * 2_000_000
        try:
            {}["forged"]
        except KeyError as error:
            logger.exception(error)  # noqa: TRY401 -- as NiceGUI does
    logger.warning("unchanged")
    assert "Traceback" not in caplog.text
    lines = [record.getMessage() for record in caplog.records]
    assert lines[0].startswith("an event of a page failed: KeyError: 'forged', test_access.py:")
    assert "25 more events of pages failed" in lines[5]
    assert (len(lines), lines[-1]) == (11, "unchanged")


@pytest.mark.parametrize(
    ("path", "is_large"),
    [
        *((path, True) for path in ("/v1/mavlink", "/mavlink2rest/mavlink/vehicles")),
        *((path, True) for path in ("/history/1", "/path/1")),
        *((path, False) for path in ("/", "/web/panel.css")),
    ],
)
async def test_large_answers_to_a_client_are_sent_one_by_one(path: str, is_large: bool) -> None:
    running: list[str] = []
    peak: list[int] = []

    async def answers(scope: Scope, receive: Receive, send: Send) -> None:
        running.append(path)
        peak.append(len(running))
        await asyncio.sleep(0.01)
        running.pop()

    guard = guarded(app=answers)
    await asyncio.gather(*(sent_by(guard, get_scope(path)) for _ in range(3)))
    assert max(peak) == (1 if is_large else 3)
    await asyncio.gather(*(sent_by(guard, get_scope(path, port)) for port in range(3)))
    assert max(peak) == 3, "others are not waited for"


async def test_client_that_takes_no_answer_is_disconnected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(access, "WRITE_S", 0.01)
    stuck: list[object] = []
    sizes: list[int] = []

    async def answers(scope: Scope, receive: Receive, send: Send) -> None:
        await Response(bytes(3 * access.PIECE + 1))(scope, receive, send)

    async def on_send(message: Message) -> None:
        sizes.append(len(message.get("body", b"")))
        if len(sizes) == 3:
            await asyncio.Event().wait()

    guard = guarded(app=answers, on_stuck=stuck.append)
    await sent_by(guard, get_scope("/"), on_send=on_send)
    assert sizes == [0, access.PIECE, access.PIECE]
    assert stuck == [("10.0.0.1", 1)]
    sizes.append(0)
    await sent_by(guard, get_scope("/"), on_send=on_send)
    assert sizes[4:] == [0, access.PIECE, access.PIECE, access.PIECE, 1]


SALT = base64.b64encode(bytes(16)).decode()


@pytest.mark.parametrize(
    "hashed",
    [
        *("scrypt$", "scrypt$x", "scrypt$16384$$", f"scrypt$16384${SALT}"),
        *(f"scrypt${cost}${SALT}${SALT}" for cost in (8192, 16385, -16384)),
        *(f"scrypt$16384${SALT}${key}" for key in ("AAAA", "?")),
        f"scrypt$16384$AAAA${SALT}",
    ],
)
@pytest.mark.parametrize("name", ["password", "viewer_password"])
def test_malformed_and_weak_hashes_are_refused(name: str, hashed: str) -> None:
    with pytest.raises(ValueError, match="--hash-password"):
        PanelSettings(**{name: hashed})
    PanelSettings(**{name: f"scrypt$16384${SALT}${SALT}"})
