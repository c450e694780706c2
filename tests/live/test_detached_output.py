"""Output that nobody reads: who writes never waits, and what fits comes whole and in order."""

import io
import logging
import os
import sys
from collections.abc import Iterator
from typing import TextIO

import pytest

from gateway.live.terminal import MAX_TEXTS, DetachedStream, detached_output

pytestmark = pytest.mark.io


@pytest.fixture
def pipe() -> Iterator[tuple[TextIO, TextIO]]:
    reader, writer = os.pipe()
    with (
        os.fdopen(reader, encoding="utf-8") as out,
        os.fdopen(writer, "w", encoding="utf-8") as into,
    ):
        yield out, into


def test_what_is_written_arrives_in_order(pipe: tuple[TextIO, TextIO]) -> None:
    out, into = pipe
    stream = DetachedStream(into)
    lines = [f"line {number}, 20 °\n" for number in range(MAX_TEXTS)]
    for line in lines:
        assert stream.write(line) == len(line)
    assert [out.readline() for _ in lines] == lines
    stream.finish()
    assert not stream._thread.is_alive()
    assert (stream.fileno(), stream.isatty(), stream.encoding) == (into.fileno(), False, "utf-8")


@pytest.mark.parametrize("blocking", [True, False])
def test_a_pipe_that_nobody_reads_holds_nobody_up(
    pipe: tuple[TextIO, TextIO], blocking: bool
) -> None:
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
    stream._waiting.put(None)
    stream._thread.join()


def test_a_reader_that_has_gone_is_no_error() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w", encoding="utf-8") as into:
        stream = DetachedStream(into)
        stream.write("to nobody\n")
        stream.finish()
        assert not stream._thread.is_alive()


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
