"""Keys of a terminal: named, without an echo, and the terminal given back as it was."""

import asyncio
import os
import pty
import termios
from collections.abc import Iterator

import pytest

from gateway.live import terminal as terminal_module
from gateway.live.terminal import Keyboard, keys_of

pytestmark = pytest.mark.io

LIMIT_S = 60
LOCAL_FLAGS = 3


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("q+ ", ["q", "+", "space"]),
        ("\x1b[A\x1b[B\x1b[C\x1b[D", ["up", "down", "right", "left"]),
        ("\x1bOA\x1b[H\x1b[F", ["up", "home", "end"]),
        ("\x1b[1;5C\x1b[3~l", ["right", "l"]),
        ("\x1b\x1bq\r\n\t\x00", ["q"]),
        ("", []),
    ],
)
def test_keys_have_names(text: str, names: list[str]) -> None:
    assert list(keys_of(text)) == names


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[int, int]]:
    """Both ends of a terminal, of which this process is taken for the one in front."""
    ours, theirs = pty.openpty()
    monkeypatch.setattr(terminal_module.os, "tcgetpgrp", lambda _: os.getpgrp())
    yield ours, theirs
    os.close(ours)
    os.close(theirs)


async def until(done: asyncio.Event) -> None:
    async with asyncio.timeout(LIMIT_S):
        await done.wait()


async def test_keys_come_one_by_one_and_are_not_echoed(terminal: tuple[int, int]) -> None:
    ours, theirs = terminal
    before = termios.tcgetattr(theirs)
    found: list[str] = []
    done = asyncio.Event()

    def take(key: str) -> None:
        found.append(key)
        if key == "q":
            done.set()

    board = Keyboard(take, theirs)
    board.start()
    assert not termios.tcgetattr(theirs)[LOCAL_FLAGS] & termios.ECHO
    os.write(ours, b" \x1b[Cq")
    await until(done)
    assert found == ["space", "right", "q"]
    board.close()
    assert termios.tcgetattr(theirs) == before
    board.close()


async def test_what_is_no_terminal_is_left_alone(tmp_path: object) -> None:
    read, write = os.pipe()
    board = Keyboard(lambda _: None, read)
    board.start()
    board.close()
    os.close(read)
    os.close(write)


async def test_a_job_in_the_background_leaves_the_terminal_alone(
    terminal: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(terminal_module.os, "tcgetpgrp", lambda _: os.getpgrp() + 1)
    before = termios.tcgetattr(terminal[1])
    board = Keyboard(lambda _: None, terminal[1])
    board.start()
    assert termios.tcgetattr(terminal[1]) == before
