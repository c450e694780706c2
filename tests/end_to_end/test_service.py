"""The gateway as a service: readiness, metrics, settings changed while it flies."""

import itertools
import os
import queue
import signal
import socket
import threading
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.live.control_socket import ControlError, request, socket_path
from tests.end_to_end.processes import CONFIG, Client, Gateway
from tests.kit.process import START_LIMIT_S, wait_for
from tests.ports import free_port, free_ports

pytestmark = [pytest.mark.io, pytest.mark.slow]

CHANGED = """
[hub]
endpoints = ["udp:127.0.0.1:{port}", "udp:127.0.0.1:{extra}?deny=ATTITUDE"]
metrics_port = {metrics}
"""


class Systemd:
    """Receives the notifications of a service at once: the kernel would keep only a few of them."""

    def __init__(self, path: Path) -> None:
        self.signs_of_life = 0
        self._notified: queue.Queue[bytes] = queue.Queue()
        self._sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._sock.bind(str(path))
        self._path = str(path)
        self._thread = threading.Thread(target=self._take)
        self._thread.start()

    def _take(self) -> None:
        while text := self._sock.recv(200).partition(b"\n")[0]:
            if text == b"WATCHDOG=1":
                self.signs_of_life += 1
            else:
                self._notified.put(text)

    def notified(self) -> bytes:
        """Wait for the next notification other than a sign of life."""
        return self._notified.get(timeout=START_LIMIT_S)

    def is_alive(self) -> None:
        """Wait for two signs of life, and for nothing else."""
        wanted = self.signs_of_life + 2
        wait_for(lambda: self.signs_of_life >= wanted)
        assert self._notified.empty()

    def close(self) -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as last:
            last.sendto(b"", self._path)
        self._thread.join()
        self._sock.close()


@pytest.fixture
def systemd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Systemd]:
    systemd = Systemd(tmp_path / "notify")
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    monkeypatch.setenv("WATCHDOG_USEC", "200000")
    yield systemd
    systemd.close()


def test_reload_changes_clients_and_leaves_no_gap(
    start_gateway: Callable[..., Gateway],
    connect: Callable[..., Client],
    systemd: Systemd,
    tmp_path: Path,
) -> None:
    gateway = start_gateway("demo")
    assert systemd.notified() == b"READY=1"
    steady = connect(gateway.port)
    extra, metrics = free_ports(2)
    numbers: list[int] = []
    settings = tmp_path / "gateway.toml"

    def follow(frames: int, kind: str = "ATTITUDE_QUATERNION") -> None:
        """Take the numbers of the aircraft's frames until so many of a kind have come."""
        while frames:
            for message in steady.receive():
                frames -= message.get_type() == kind
                if message.get_srcComponent() == 1:
                    numbers.append(message.get_seq())

    # Home is set, and its parameters change, which no client has asked for.
    follow(1, "HOME_POSITION")
    systemd.is_alive()
    settings.write_text(CHANGED.format(port=gateway.port, extra=extra, metrics=metrics))
    gateway.process.send_signal(signal.SIGHUP)
    assert [systemd.notified(), systemd.notified()] == [b"RELOADING=1", b"READY=1"]
    follow(10)
    newcomer = connect(extra)
    seen = newcomer.until(lambda seen: {"HEARTBEAT", "ATTITUDE_QUATERNION"} <= set(seen))
    assert "ATTITUDE" not in seen
    place = f"http://127.0.0.1:{metrics}/metrics"
    with urllib.request.urlopen(place, timeout=START_LIMIT_S) as page:
        text = page.read().decode()
    assert f'remote="127.0.0.1:{extra}"' in text
    settings.write_text("[hub]\nendpoints = 7\n")
    gateway.process.send_signal(signal.SIGHUP)
    wait_for(lambda: "settings not reloaded" in gateway.log.read_text())
    follow(10)
    steps = {(after - before) % 256 for before, after in itertools.pairwise(numbers)}
    assert steps == {1}
    systemd.is_alive()
    assert gateway.end() == 0
    assert systemd.notified() == b"STOPPING=1"


def test_closed_terminal_ends_all_processes_of_demo(
    start_gateway: Callable[..., Gateway], tmp_path: Path
) -> None:
    master, terminal = os.openpty()
    config = f'{CONFIG}\n[recording]\nfolder = "{tmp_path}"\n'
    gateway = start_gateway("demo", "--record", config=config, terminal=terminal)
    os.close(terminal)
    wait_for(lambda: any(path.stat().st_size > 0 for path in tmp_path.glob("*.csv")))
    os.close(master)
    assert gateway.process.wait(START_LIMIT_S) == 0, gateway.log.read_text()
    assert "the simulated receiver has ended" not in gateway.log.read_text()
    [table] = tmp_path.glob("*.csv")
    assert table.read_bytes().endswith(b"\n")

    def is_gone() -> bool:
        try:
            os.killpg(gateway.process.pid, 0)
        except ProcessLookupError:
            return True
        return False

    wait_for(is_gone)


def test_reload_changes_the_signing(
    start_gateway: Callable[..., Gateway], connect: Callable[..., Client], tmp_path: Path
) -> None:
    gateway = start_gateway("demo")
    client = connect(gateway.port)

    def until_signed(wanted: bool) -> None:
        client.until(
            lambda seen: "ATTITUDE" in seen and bool(seen["ATTITUDE"].get_msgbuf()[2] & 1) is wanted
        )

    until_signed(False)
    settings = tmp_path / "gateway.toml"
    plain = settings.read_text()
    settings.write_text(f'{plain}\n[vehicle]\nsigning_passphrase = "correct horse"\n')
    gateway.process.send_signal(signal.SIGHUP)
    until_signed(True)
    settings.write_text(plain)
    gateway.process.send_signal(signal.SIGHUP)
    until_signed(False)


def test_recording_is_accepted_only_when_it_runs(
    start_gateway: Callable[..., Gateway], connect: Callable[..., Client], tmp_path: Path
) -> None:
    in_the_way = tmp_path / "flights"
    in_the_way.write_text("a file where the folder should be")
    config = f'{CONFIG}\n[recording]\nfolder = "{in_the_way}/today"\n'
    gateway = start_gateway("demo", config=config)
    # Commands reach a vehicle from its first heartbeat on.
    connect(gateway.port).until(lambda seen: "HOME_POSITION" in seen)
    client = connect()
    client.introduce(gateway.listen_port)
    in_progress = mavlink.MAV_RESULT_IN_PROGRESS

    def order() -> list[int]:
        """Request a recording; return its results up to the final one."""
        number = mavlink.MAV_CMD_LOGGING_START
        start = mavlink.MAVLink_command_long_message(1, 1, number, 0, *[0] * 7)
        client.send(start, gateway.listen_port)
        results: list[int] = []
        while results in ([], [in_progress]):
            found = (m for m in client.receive() if m.get_type() == "COMMAND_ACK")
            results += [m.result for m in found if m.command == number]
        return results

    def is_reported(seen: dict[str, mavlink.MAVLink_message]) -> bool:
        # The path makes it longer than one chunk.
        return "STATUSTEXT" in seen and "Cannot record: " in seen["STATUSTEXT"].text

    assert order() == [in_progress, mavlink.MAV_RESULT_FAILED]
    client.until(is_reported)
    in_the_way.unlink()
    assert order() == [in_progress, mavlink.MAV_RESULT_ACCEPTED]
    assert list(in_the_way.glob("today/*.tlog"))


def test_orders_reach_the_hub(
    start_gateway: Callable[..., Gateway],
    connect: Callable[..., Client],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    gateway = start_gateway("demo")
    # Of the aircraft, which is heard after the control socket is there.
    connect(gateway.port).until(lambda seen: "ATTITUDE" in seen)
    control = socket_path("run")
    extra = free_port()
    url = f"udp:127.0.0.1:{extra}?name=tablet&allow=HEARTBEAT"
    assert url in request(control, "clients.add", {"url": url})
    newcomer = connect(extra)
    assert {message.get_type() for _ in range(3) for message in newcomer.receive()} == {"HEARTBEAT"}
    (tablet,) = (c for c in request(control, "status")["clients"] if c["name"] == "tablet")
    assert (tablet["state"], tablet["trusted"]) == ("open", True)
    assert tablet["sent"] >= 3
    assert request(control, "reload") == "settings of the hub and of signing applied"
    assert url not in request(control, "clients.remove", {"name": "tablet"})
    with pytest.raises(ControlError, match="tablet"):
        request(control, "clients.remove", {"name": "tablet"})
