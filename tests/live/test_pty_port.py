"""The pseudo-terminal: every byte reaches a reader, and none is kept without one."""

import asyncio
import errno
import os
import select
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
import serial

from gateway.live.pty_port import PtyPort
from gateway.simulator.timed_frame import TimedFrame
from gateway.wire.framing import Fault, FrameDecoder, encode_frame
from tests.conftest import LoopTime
from tests.kit.process import until

pytestmark = pytest.mark.io

CONTENT_SIZE = 40


def frames(count: int, rate_hz: float = 20_000.0) -> Iterator[TimedFrame]:
    for k in range(count):
        yield TimedFrame(k / rate_hz, encode_frame(k.to_bytes(4, "big") * (CONTENT_SIZE // 4)))


def numbers(events: list[bytes | Fault]) -> list[int]:
    assert all(isinstance(event, bytes) for event in events)
    return [int.from_bytes(event[:4], "big") for event in events if isinstance(event, bytes)]


class Reader:
    """Opens a port as the gateway does and collects its frames."""

    def __init__(self, path: str) -> None:
        self.events: list[bytes | Fault] = []
        self._decoder = FrameDecoder()
        self.port = serial.Serial(path, 500_000, timeout=0, exclusive=True)
        asyncio.get_running_loop().add_reader(self.port.fileno(), self.read)

    async def until(self, count: int) -> None:
        await until(lambda: len(self.events) >= count)

    def close(self) -> None:
        asyncio.get_running_loop().remove_reader(self.port.fileno())
        self.port.close()

    def read(self) -> None:
        self.events += self._decoder.feed(self.port.read(4096))


Play = Callable[[Iterator[TimedFrame]], PtyPort]


@pytest.fixture
async def play() -> AsyncIterator[Play]:
    with ExitStack() as opened:

        def make(source: Iterator[TimedFrame]) -> PtyPort:
            opened.callback((port := PtyPort(source)).close)
            return port

        yield make


async def test_every_frame_reaches_the_reader(play: Play) -> None:
    def paced() -> Iterator[TimedFrame]:
        for sent, frame in enumerate(frames(2000)):
            # The kernel keeps some kB only, and hands them over when it has the time.
            while sent > 100 and sent - len(reader.events) > 100:
                select.select([reader.port], [], [], 60.0)
                reader.read()
            yield frame

    port = play(paced())
    reader = Reader(port.path)
    port.start()
    await reader.until(2000)
    await asyncio.wait_for(port.ended.wait(), 60.0)
    reader.close()
    assert numbers(reader.events) == list(range(2000))
    assert (port.written, port.dropped) == (2000, 0)


async def test_frames_keep_their_times(play: Play) -> None:
    loop = asyncio.get_running_loop()
    port = play(frames(6, rate_hz=50.0))
    reader = Reader(port.path)
    begin_s = loop.time()
    port.start()
    for k in range(6):
        await reader.until(k + 1)
        assert loop.time() - begin_s >= k / 50.0
    reader.close()


async def test_frames_without_a_reader_are_dropped(play: Play) -> None:
    port = play(frames(3000))
    port.start()
    await asyncio.wait_for(port.ended.wait(), 60.0)
    assert port.written + port.dropped == 3000
    assert port.written * CONTENT_SIZE < 100_000, "only what the kernel holds"
    assert port.dropped > 500
    assert Path(port.path).exists()
    for _ in range(2):
        port.close()
    assert not Path(port.path).exists()


async def test_reader_that_opens_late_and_again_gets_whole_frames(
    play: Play,
) -> None:
    port = play(frames(10**9))
    port.start()
    await until(lambda: port.dropped)
    for _ in range(3):
        reader = Reader(port.path)
        await reader.until(50)
        reader.close()
        # Flushing on opening may cut the first frame; from there on all are whole.
        seen = numbers(reader.events[1:])
        assert seen == sorted(seen)
    assert not port.ended.is_set()


async def test_partly_written_frame_is_finished_before_the_next(
    play: Play,
) -> None:
    """A frame that half fits is finished before any other is begun."""
    port = play(frames(4000))
    slave = os.open(port.path, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
    decoder, events = FrameDecoder(), []
    port.start()
    while not port.ended.is_set():
        # Reading odd sizes only when the terminal is full makes every kind of partial write.
        if port.dropped:
            events += decoder.feed(os.read(slave, 777))
            port.dropped = 0
        await asyncio.sleep(0)
    os.close(slave)
    assert len(events) > 100
    seen = numbers(events)
    assert seen == sorted(set(seen))


async def test_frames_continue_at_their_rate_after_a_standstill(
    play: Play, loop_time: LoopTime
) -> None:
    port = play(frames(1000, rate_hz=100.0))
    reader = Reader(port.path)
    port.start()
    await reader.until(3)
    # An hour passes for the loop's clock: only the frame that is late comes at once.
    begin_s = loop_time()
    loop_time.ahead_s = 3600.0
    await reader.until(6)
    reader.close()
    port.close()
    # On a busy machine more of them have become due meanwhile.
    assert port.written <= 20 + 100 * (loop_time() - loop_time.ahead_s - begin_s)


async def test_frames_that_are_made_too_slowly_are_not_all_dropped(
    play: Play, loop_time: LoopTime
) -> None:
    """Each takes twice its interval to be made, as on a computer without processor time."""

    def slowly() -> Iterator[TimedFrame]:
        for frame in frames(2000, rate_hz=100.0):
            loop_time.ahead_s += 0.02
            yield frame

    port = play(slowly())
    reader = Reader(port.path)
    port.start()
    await reader.until(300)
    reader.close()
    port.close()
    assert port.dropped < 10 * port.written


def test_machine_without_terminals_is_named_before_frames_are_made(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def none_left() -> tuple[int, int]:
        raise OSError(errno.ENODEV, "out of pty devices")

    monkeypatch.setattr(os, "openpty", none_left)
    made = frames(1)
    with pytest.raises(OSError, match="pseudo-terminal of the simulated receiver"):
        PtyPort(made)
    assert next(made), "not started"
