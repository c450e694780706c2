"""A computer that stops or is too slow must not look like a fault of the hardware."""

import math
import signal
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.live.control_socket import request, socket_path
from gateway.live.service import WARM_UP_US
from gateway.units import US_PER_S
from tests.end_to_end.processes import Client, Gateway

pytestmark = [pytest.mark.io, pytest.mark.slow]

BLAMES = ("restart", "silent", "Sensor", "sensor", "GPS fix lost", "bus error", "radio")
"""Parts of texts that name the hardware."""
STOPPED_S = 3.0
WATCHED_S = 5.0
"""Longer than a silent node or a lost fix takes to be reported."""
MAX_SPIKE_M = 20.0


def messages(client: Client, seconds: float) -> Iterator[mavlink.MAVLink_message]:
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        yield from client.receive()


def jumps_m(track: list[mavlink.MAVLink_message]) -> Iterator[float]:
    """Yield by how much each position differs from the last one moved on at its velocity."""
    for a, b in pairwise(track):
        dt_s = (b.time_boot_ms - a.time_boot_ms) / 1e3
        assert dt_s > 0.0
        north_m = (b.lat - a.lat) * 0.0111 - b.vx / 100 * dt_s
        east_m = (b.lon - a.lon) * 0.0111 * math.cos(math.radians(a.lat / 1e7)) - b.vy / 100 * dt_s
        yield math.hypot(north_m, east_m)


def test_stopped_process_blames_no_hardware(
    start_gateway: Callable[..., Gateway],
    connect: Callable[..., Client],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    gateway = start_gateway("demo")
    client = connect(gateway.port)
    before: list[mavlink.MAVLink_message] = []
    while not any(m.get_type() == "GLOBAL_POSITION_INT" for m in before):
        before += client.receive()
    before += messages(client, WARM_UP_US / US_PER_S)
    gateway.process.send_signal(signal.SIGSTOP)
    time.sleep(STOPPED_S)
    gateway.process.send_signal(signal.SIGCONT)
    after = list(messages(client, WATCHED_S))
    texts = [m.text for m in before + after if m.get_type() == "STATUSTEXT"]
    # Once also on a busy machine, on which it is too slow before.
    assert sum(text.startswith("This computer is too slow") for text in texts) == 1
    texts = [m.text for m in after if m.get_type() == "STATUSTEXT"]
    assert [text for text in texts if any(blame in text for blame in BLAMES)] == []
    track = [m for m in before + after if m.get_type() == "GLOBAL_POSITION_INT"]
    # The velocity changes over the gap itself, which the estimator bridges.
    spikes = [jump for jump in jumps_m(track) if jump > MAX_SPIKE_M]
    assert spikes == []
    status = request(socket_path("run"), "status")
    assert status["slow_s"] > STOPPED_S / 2
    assert [node["restarts"] for node in status["report"]["nodes"]] == [0, 0]
