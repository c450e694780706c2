"""A Zenoh router in another process."""

import signal
import subprocess
import sys
from collections.abc import Iterator

import pytest

from tests.ports import free_port

ROUTER = """
import sys
from gateway.hub.transports.zenoh.session import open_session, session_config
config = session_config(sys.argv[1], "", "router")
# Clients keep their link to a router that has stalled.
config.insert_json5("transport/link/tx/lease", "3600000")
session = open_session(config)
print("open", flush=True)
sys.stdin.read()
"""


class Router:
    """A router as a process that can be killed, stopped and started again at the same locator."""

    def __init__(self) -> None:
        self.locator = f"tcp/127.0.0.1:{free_port()}"
        self.process: subprocess.Popen[str] | None = None
        self.start()

    def start(self) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", ROUTER, self.locator],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == "open\n"

    def kill(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.communicate()
            self.process = None

    def signal(self, number: signal.Signals) -> None:
        assert self.process is not None
        self.process.send_signal(number)

    def restore(self) -> None:
        """Let it run again, whatever a test has done with it."""
        if self.process is None:
            self.start()
        self.signal(signal.SIGCONT)


@pytest.fixture(scope="module")
def router() -> Iterator[Router]:
    router = Router()
    yield router
    router.kill()
