"""The end of a process, output that is not read, and the keys of a terminal."""

import asyncio
import io
import logging
import os
import pty
import select
import signal
import subprocess
import sys
import termios
import threading
from collections.abc import Iterator
from typing import TextIO

import pytest

from gateway.live import terminal as terminal_module
from gateway.live.terminal import (
    MAX_TEXTS,
    DetachedStream,
    Keyboard,
    detached_output,
    keys_of,
    on_end_signals,
)
from tests.kit.process import until

pytestmark = pytest.mark.io

LIMIT_S = 60

CHILD = """
import asyncio
from gateway.live.terminal import on_parent_gone

async def main():
    gone = asyncio.Event()
    on_parent_gone(gone.set)
    print("ready", flush=True)
    await gone.wait()

asyncio.run(main())
"""
PARENT = """
import subprocess, sys
child = subprocess.Popen([sys.executable, "-c", sys.argv[1]], stdin=subprocess.PIPE)
print(child.pid, flush=True)
child.wait()
"""


def test_child_ends_when_its_parent_is_killed() -> None:
    words = [sys.executable, "-c", PARENT, CHILD]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        first, second = sorted(parent.stdout.readline().strip() for _ in range(2))
        assert second == "ready"
        child = os.pidfd_open(int(first))
        try:
            assert not select.select([child], [], [], 0)[0]
            parent.send_signal(signal.SIGKILL)
            assert select.select([child], [], [], 120)[0]
        finally:
            os.close(child)


@pytest.mark.parametrize("is_ignored", [False, True], ids=["usual", "with nohup"])
async def test_ignored_hangup_stays_ignored(is_ignored: bool) -> None:
    """As `nohup` has it."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN if is_ignored else signal.SIG_DFL)
    calls: list[bool] = []
    on_end_signals(lambda: calls.append(True))
    try:
        signal.raise_signal(signal.SIGHUP)
        signal.raise_signal(signal.SIGTERM)
        await until(lambda: calls)
        assert len(calls) == (1 if is_ignored else 2)
    finally:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            asyncio.get_running_loop().remove_signal_handler(number)
        signal.signal(signal.SIGHUP, before)


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the end wait for output as long as a busy machine needs."""
    monkeypatch.setattr(terminal_module, "FLUSH_TIMEOUT_S", LIMIT_S)


@pytest.fixture
def pipe() -> Iterator[tuple[TextIO, TextIO]]:
    reader, writer = os.pipe()
    with (
        os.fdopen(reader, encoding="utf-8") as out,
        os.fdopen(writer, "w", encoding="utf-8") as into,
    ):
        yield out, into


def is_writing() -> bool:
    return any(thread.name == "output" for thread in threading.enumerate())


@pytest.mark.usefixtures("patient")
def test_written_texts_arrive_in_order(pipe: tuple[TextIO, TextIO]) -> None:
    out, into = pipe
    stream = DetachedStream(into)
    lines = [f"line {number}, 20 °\n" for number in range(MAX_TEXTS)]
    for line in lines:
        assert stream.write(line) == len(line)
    assert [out.readline() for _ in lines] == lines
    stream.finish()
    assert not is_writing()
    assert (stream.fileno(), stream.isatty(), stream.encoding) == (into.fileno(), False, "utf-8")


@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize("blocking", [True, False], ids=["blocking", "not blocking"])
def test_unread_pipe_does_not_block_the_writer(pipe: tuple[TextIO, TextIO], blocking: bool) -> None:
    """Two texts do not fit into the pipe's 64 kB: a plain stream would wait here for ever."""
    out, into = pipe
    os.set_blocking(into.fileno(), blocking)
    stream = DetachedStream(into)
    texts = [f"{number:06d} {'x' * 50_000}\n" for number in range(2 * MAX_TEXTS)]
    for text in texts:
        stream.write(text)
    # One or two are being written, and MAX_TEXTS wait.
    heard = [out.readline() for _ in range(MAX_TEXTS)]
    assert heard == texts[:MAX_TEXTS]
    # Without a reader the rest is soon gone, and the thread ends before its file is closed.
    out.close()
    while is_writing():
        stream.finish()


def test_log_and_prints_are_detached_and_attached_again(
    pipe: tuple[TextIO, TextIO], monkeypatch: pytest.MonkeyPatch
) -> None:
    out, into = pipe
    plain = io.StringIO()
    monkeypatch.setattr("sys.stderr", into)
    monkeypatch.setattr("sys.stdout", plain)
    handler = logging.StreamHandler()
    logging.getLogger().addHandler(handler)
    try:
        with detached_output():
            assert isinstance(sys.stderr, DetachedStream)
            assert sys.stdout is plain, "it has no file that could block"
            logging.getLogger("test").warning("heard")
            sys.stderr.write("too\n")
        assert sys.stderr is into
        assert handler.stream is into
    finally:
        logging.getLogger().removeHandler(handler)
    assert [out.readline(), out.readline()] == ["heard\n", "too\n"]


LOCAL_FLAGS = 3


def test_key_sequences_are_named() -> None:
    for text, names in (
        ("q+ ", ["q", "+", "space"]),
        ("\x1b[A\x1b[B\x1b[C\x1b[D", ["up", "down", "right", "left"]),
        ("\x1bOA\x1b[H\x1b[F", ["up", "home", "end"]),
        ("\x1b[1;5C\x1b[3~l", ["right", "l"]),
        ("\x1b\x1bq\r\n\t\x00", ["q"]),
    ):
        assert list(keys_of(text)) == names, text


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[int, int]]:
    """Both ends of a terminal, of which this process is taken for the one in front."""
    ours, theirs = pty.openpty()
    monkeypatch.setattr(os, "tcgetpgrp", lambda _: os.getpgrp())
    yield ours, theirs
    os.close(ours)
    os.close(theirs)


async def test_keys_come_one_by_one_and_are_not_echoed(terminal: tuple[int, int]) -> None:
    ours, theirs = terminal
    before = termios.tcgetattr(theirs)
    found: list[str] = []
    board = Keyboard(found.append, theirs)
    board.start()
    assert not termios.tcgetattr(theirs)[LOCAL_FLAGS] & termios.ECHO
    os.write(ours, b" \x1b[Cq")
    await until(lambda: "q" in found)
    assert found == ["space", "right", "q"]
    board.close()
    assert termios.tcgetattr(theirs) == before
    board.close()


async def test_keyboard_leaves_a_pipe_and_the_terminal_of_a_background_job_unchanged(
    terminal: tuple[int, int], pipe: tuple[TextIO, TextIO], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "tcgetpgrp", lambda _: os.getpgrp() + 1)
    before = termios.tcgetattr(terminal[1])
    for descriptor in (terminal[1], pipe[0].fileno()):
        board = Keyboard(lambda _: None, descriptor)
        board.start()
        assert termios.tcgetattr(terminal[1]) == before
        board.close()
