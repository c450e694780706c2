"""A `mavgate` command as its users start it: a process of its own, its output in a file."""

import asyncio
import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Self, TypeVar

START_LIMIT_S = 60.0
"""A start takes a second, on a busy machine some more."""

Found = TypeVar("Found")


def wait_for(look: Callable[[], Found | None], describe: Callable[[], str] = str) -> Found:
    """Look again and again until there is something."""
    deadline_s = time.monotonic() + START_LIMIT_S
    while not (found := look()):
        assert time.monotonic() < deadline_s, f"not in {START_LIMIT_S:.0f} s:\n{describe()}"
        time.sleep(0.02)
    return found


async def until(condition: Callable[[], object], pause_s: float = 0.0) -> None:
    """Let the event loop run until something holds."""
    async with asyncio.timeout(START_LIMIT_S):
        while not condition():
            await asyncio.sleep(pause_s)


def python(*words: object, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run Python to its end, with options of `subprocess.run`; by default it must succeed."""
    plain = {"capture_output": True, "text": True, "check": True}
    return subprocess.run([sys.executable, *map(str, words)], **plain | options)


@contextlib.contextmanager
def running(*words: object) -> Iterator[subprocess.Popen[bytes]]:
    """Run another program meanwhile."""
    with subprocess.Popen([*map(str, words)], stderr=subprocess.DEVNULL) as process:
        try:
            yield process
        finally:
            process.kill()


class Process:
    """A command that runs until it is ended; settings, output and control socket are in `folder`.

    `config` is the text of its settings file, `options` are those of `subprocess.Popen`.
    """

    def __init__(self, folder: Path, *arguments: str, config: str, **options: Any) -> None:
        file = folder / "gateway.toml"
        file.write_text(config)
        self.log = folder / f"{arguments[0]}-{time.monotonic_ns()}.log"
        environment = {"XDG_RUNTIME_DIR": str(folder), "COLUMNS": "200"}
        with self.log.open("w") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "gateway.cli", *arguments, "--config", str(file)],
                stdout=log,
                stderr=subprocess.STDOUT,
                **{"env": os.environ | environment} | options,
            )

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """End it with the block."""
        self.end()

    def until(self, pattern: str) -> re.Match[str]:
        """Wait until the output holds a pattern."""
        return wait_for(lambda: re.search(pattern, self.log.read_text()), self.log.read_text)

    def link(self) -> str:
        """Wait for the address of the panel's page."""
        return self.until(r"panel: (https?://\S+)")[1]

    def end(self, how: signal.Signals = signal.SIGTERM) -> int:
        """End it, whatever that takes; return its exit code."""
        if self.process.poll() is None:
            self.process.send_signal(how)
        try:
            return self.process.wait(START_LIMIT_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            return self.process.wait()
