"""Slots by role, session and address; logins, pages and answers that share them."""

import asyncio
import itertools
from types import SimpleNamespace
from typing import Any

import pytest
from nicegui import core

from gateway.panel.access import HOLDER
from gateway.panel.admission import Holder, Role, Slots
from gateway.panel.logins import SESSIONS_OF_ROLE, BusyError, FairTurns, Logins, hash_password
from gateway.panel.open_pages import PENDING_OF_SESSION, OpenPages

OPERATOR, VIEWER = Role.OPERATOR, Role.VIEWER


def holder(role: Role | None, session: str = "", address: str = "a") -> Holder:
    return Holder(role, session, address)


VIEWERS = [holder(VIEWER, str(n), str(n)) for n in range(5)]


@pytest.mark.parametrize(
    ("before", "newcomer", "evicted"),
    [
        ([holder(VIEWER, "v")] * 2, holder(VIEWER, "v"), [0]),
        ([holder(VIEWER, "v"), holder(VIEWER, "0"), holder(VIEWER, "1")], holder(VIEWER, "x"), [0]),
        (
            [
                holder(VIEWER, "1", "b"),
                *(holder(VIEWER, str(n), "a") for n in range(2, 5)),
                holder(VIEWER, "5", "c"),
            ],
            holder(VIEWER, "x", "d"),
            [1],
        ),
        ([holder(OPERATOR, "o"), *VIEWERS], holder(VIEWER, "x", "x"), [1]),
        (VIEWERS, holder(OPERATOR, "o", "0"), []),
        ([holder(None)] * 3, holder(None), [0]),
    ],
    ids=["own session", "own address", "address with most", "role", "another role", "no session"],
)
def test_newcomer_takes_a_place_of_its_kind(
    before: list[Holder], newcomer: Holder, evicted: list[int]
) -> None:
    gone: list[int] = []
    slots: Slots[int] = Slots(2, 3, 5, gone.append)
    waiting: Slots[int] = Slots(2, 3, 5)
    for number, each in enumerate(before):
        assert slots.admit(number, each)
        waiting.admit(number, each)
    assert slots.admit(99, newcomer)
    assert gone == evicted
    held = {each for each in (*range(len(before)), 99) if slots.holder(each)}
    assert held == {*range(len(before)), 99} - {*evicted}
    assert waiting.admit(99, newcomer) == (not evicted)


def test_many_logins_of_viewers_log_no_operator_out() -> None:
    ended: list[str] = []
    logins = Logins("hash", "hash", ended.append)
    operator = logins.open_session(OPERATOR, "10.0.0.1")
    viewers = [logins.open_session(VIEWER, f"10.0.{n % 7}.1") for n in range(200)]
    assert logins.role_of(operator) is OPERATOR
    assert logins.role_of(viewers[-1]) is VIEWER
    assert len(ended) == len(set(ended)) == 200 - SESSIONS_OF_ROLE


async def test_wrong_passwords_of_many_networks_delay_a_login_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    checked: list[str] = []
    logins = Logins("hash", "")

    def check(password: str, hashed: str) -> bool:
        checked.extend([password] if hashed else [])
        return password == "right"

    monkeypatch.setattr("gateway.panel.logins.matches", check)
    assert await logins.check("192.168.1.7", "right") is OPERATOR
    attempts = [
        asyncio.create_task(logins.check(f"10.0.{network}.{number}", "wrong"))
        for number, network in itertools.product(range(1, 50), range(3))
    ]
    await asyncio.sleep(0)
    checked.clear()
    assert await logins.check("192.168.1.7", "right") is OPERATOR
    assert len(checked) <= 5
    found = await asyncio.gather(*attempts, return_exceptions=True)
    assert sum(isinstance(each, BusyError) for each in found) > 100
    assert await logins.check("10.0.0.200", "right") is OPERATOR, "the turns are free again"


async def test_cancelled_login_passes_its_turn_on() -> None:
    logins = Logins(hash_password("x"), "")
    tasks = [asyncio.create_task(logins.check("10.0.0.1", "y")) for _ in range(3)]
    await asyncio.sleep(0)
    for task in tasks[:2]:
        task.cancel()
    assert await tasks[2] is None


async def test_turn_of_a_caller_cancelled_at_once_is_passed_on() -> None:
    turns, may_end, done = FairTurns(), asyncio.Event(), []

    async def call(number: int) -> None:
        async with turns.turn("network", is_known=True):
            await may_end.wait()
            done.append(number)

    tasks = [asyncio.create_task(call(number)) for number in range(3)]
    await asyncio.sleep(0)
    may_end.set()
    # The first one ends, and gives its turn to the second, which is not run yet.
    await asyncio.sleep(0)
    tasks[1].cancel()
    async with asyncio.timeout(60.0):
        await tasks[2]
    assert done == [0, 2]


class Page:
    """A page as NiceGUI has it."""

    def __init__(self, number: int) -> None:
        self.id = str(number)
        self.is_deleted = False
        self.handlers: dict[str, Any] = {}

    def on_connect(self, handle: Any) -> None:
        self.handlers["connect"] = handle

    def on_delete(self, handle: Any) -> None:
        self.handlers["delete"] = handle

    def delete(self) -> None:
        self.is_deleted = True
        self.handlers["delete"]()


def environ(session: str) -> dict[str, Any]:
    return {"asgi.scope": {HOLDER: holder(VIEWER, session)}}


def test_pages_that_are_loaded_and_abandoned_delete_no_others() -> None:
    pages = OpenPages()
    operators: Any = Page(0)
    pages.add(operators, holder(OPERATOR, "o"))
    loaded: list[Any] = [Page(number) for number in range(1, 100)]
    for page in loaded:
        pages.add(page, holder(VIEWER, "v"))
    assert not operators.is_deleted
    assert [page.is_deleted for page in loaded].count(False) == PENDING_OF_SESSION


def test_deleted_page_leaves_its_place_to_others() -> None:
    pages = OpenPages()
    loaded: list[Any] = [Page(number) for number in range(PENDING_OF_SESSION + 1)]
    for page in loaded:
        pages.add(page, holder(VIEWER, "v"))
        if page is loaded[1]:
            page.delete()
    assert [page for page in loaded if page.is_deleted] == [loaded[1]]


def test_page_takes_messages_of_its_own_session_and_ends_with_it() -> None:
    pages = OpenPages()
    page: Any = Page(1)
    pages.add(page, holder(VIEWER, "mine"))
    page.handlers["connect"]()
    assert pages.belongs("1", environ("mine"))
    for other in (environ("another"), environ(""), {}):
        assert not pages.belongs("1", other)
    pages.end_session("another")
    assert not page.is_deleted
    pages.end_session("mine")
    assert page.is_deleted
    assert pages.belongs("1", {}), "a page that does not exist is refused elsewhere"


async def test_every_message_to_a_page_is_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    pages = OpenPages()
    page: Any = Page(1)
    pages.add(page, holder(VIEWER, "mine"))
    called: list[str] = []
    handlers = {
        name: (lambda *_, name=name: called.append(name))
        for name in ("handshake", "event", "javascript_response", "ack", "log")
    }

    async def connect(*_: Any) -> None:
        called.append("connect")

    registered: dict[str, Any] = {}
    sio = SimpleNamespace(
        handlers={"/": {**handlers, "connect": connect}},
        on=registered.__setitem__,
        get_environ=environ,
    )
    monkeypatch.setattr(core, "sio", sio)
    pages.guard_socket()
    for session, wanted in (("another", []), ("mine", [*handlers])):
        called.clear()
        for name in handlers:
            await registered[name](session, {"client_id": "1"})
        assert called == wanted
    query = {"QUERY_STRING": "implicit_handshake=true&client_id=1"}
    assert await registered["connect"]("sid", environ("another") | query) is False
    await registered["connect"]("sid", environ("mine") | query)
    assert called[-1] == "connect"
