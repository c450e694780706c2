"""The serial port: choice, unplugging, coming back."""

import asyncio
import contextlib
import os
import select
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import serial

from gateway.live import serial_port
from gateway.live.control_socket import ControlServer
from gateway.live.control_verbs import serial_verbs
from gateway.live.serial_port import (
    LONGEST_RETRY_S,
    Port,
    PortNotFoundError,
    SerialPort,
    SerialSettings,
    find_port,
    find_receiver,
    open_port,
)
from gateway.wire.framing import encode_frame
from tests.kit.process import until
from tests.live.test_control_verbs import ask

CH340 = Port("/dev/ttyUSB0", "1a86:7523", "", "WCH CH340", known=True)
FTDI = Port("/dev/ttyUSB1", "0403:6001", "A50285BI", "FTDI FT232R", known=True)
FTDI_2 = Port("/dev/ttyUSB2", "0403:6001", "XYZ", "FTDI FT232R", known=True)
MODEM = Port("/dev/ttyACM0", "2cb7:0a05", "", "modem", known=False)
BUILT_IN = Port("/dev/ttyS0", "", "", "n/a", known=False)


def test_port_is_found_by_device_adapter_or_usb_id() -> None:
    for wanted, ports, found in (
        ("/dev/ttyAMA0", [], "/dev/ttyAMA0"),
        ("auto", [MODEM, CH340, BUILT_IN], "/dev/ttyUSB0"),
        ("usb:2cb7:0a05", [CH340, MODEM], "/dev/ttyACM0"),
        ("usb:1A86:7523", [FTDI, CH340], "/dev/ttyUSB0"),
        ("usb:0403:6001:a50285bi", [FTDI_2, FTDI], "/dev/ttyUSB1"),
    ):
        assert find_port(wanted, ports) == found, wanted


def test_error_of_find_port_lists_the_ports() -> None:
    for wanted, ports, text in (
        ("auto", [], "no port at all"),
        ("auto", [MODEM, BUILT_IN], r"/dev/ttyACM0 \(2cb7:0a05\), /dev/ttyS0 \(no USB\)"),
        ("auto", [CH340, FTDI], "several USB adapters fit"),
        ("usb:dead:beef", [CH340], "no port fits 'usb:dead:beef'"),
        ("none", [], r"serial.port = none"),
    ):
        with pytest.raises(PortNotFoundError, match=text):
            find_port(wanted, ports)


@pytest.mark.io
def test_reason_of_a_failed_opening_names_the_known_adapters(adapters: "Adapters") -> None:
    held, missing = adapters.plug(), "No such file or directory"
    found = f"{missing}; /dev/ttyUSB0 is there, always found as usb:1a86:7523"
    with serial.Serial(held, timeout=0, exclusive=True):
        for device, ports, reason in (
            ("/dev/ttyUSB99", [MODEM], missing),
            ("/dev/ttyUSB99", [CH340, MODEM], found),
            ("/dev/null", [CH340], "not a serial port"),
            (held, [CH340], "another program has it open"),
        ):
            with pytest.raises(PortNotFoundError) as raised:
                open_port(device, 9600, ports)
            assert str(raised.value) == f"serial port {device}: {reason}"


class Adapters:
    """Pseudo-terminals in the place of several known USB adapters."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.masters: dict[str, int] = {}
        monkeypatch.setattr("gateway.live.serial_port.list_serial_ports", self.ports)

    def ports(self) -> list[Port]:
        return [Port(device, "1a86:7523", "", "WCH CH340", known=True) for device in self.masters]

    def plug(self, link: Path | None = None) -> str:
        """Open a terminal, which a link may name, and return its name."""
        master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(master, False)
        device = os.ttyname(slave)
        os.close(slave)
        if link is not None:
            link.symlink_to(device)
            device = str(link)
        self.masters[device] = master
        return device

    def pull(self, device: str) -> None:
        if Path(device).is_symlink():
            Path(device).unlink()
        os.close(self.masters.pop(device))


@pytest.fixture
def adapters(monkeypatch: pytest.MonkeyPatch) -> Iterator[Adapters]:
    adapters = Adapters(monkeypatch)
    yield adapters
    for device in [*adapters.masters]:
        adapters.pull(device)


class Listener:
    def __init__(self) -> None:
        self.data = b""
        self.sizes: list[int] = []
        self.opened = 0
        self.devices: list[str] = []
        self.lost: list[str] = []
        self.changed = asyncio.Event()

    def on_bytes(self, data: bytes, now_us: int) -> None:
        self.data += data
        self.sizes.append(len(data))
        self.changed.set()

    def on_open(self, device: str) -> None:
        self.opened += 1
        self.devices.append(device)
        self.changed.set()

    def on_lost(self, device: str) -> None:
        self.lost.append(device)

    def port(
        self, wanted: str = "auto", now_us: Callable[[], int] = lambda: 42, **how: bool
    ) -> SerialPort:
        settings = SerialSettings(port=wanted)
        return SerialPort(settings, self.on_bytes, self.on_open, self.on_lost, now_us, **how)

    async def until(self, *, opened: int = 0, data: bytes = b"") -> None:
        async with asyncio.timeout(60):
            while self.opened < opened or data not in self.data:
                self.changed.clear()
                await self.changed.wait()


@pytest.fixture
def listener() -> Listener:
    return Listener()


@pytest.fixture
def fast_retry(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gateway.live.serial_port.FIRST_RETRY_S", 0.005)


@pytest.mark.io
@pytest.mark.usefixtures("fast_retry")
@pytest.mark.parametrize("needed", [True, False], ids=["needed", "not needed"])
async def test_port_is_opened_again_after_it_was_unplugged(
    adapters: Adapters,
    listener: Listener,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    needed: bool,
) -> None:
    """One that is not needed is missed only after it was there."""
    link = tmp_path / "ttyRECEIVER"
    port = listener.port(str(link), needed=needed)
    port.start()
    assert not port.connected
    missing = f"serial port {link}: No such file or directory; trying again until it works"
    assert [record.getMessage() for record in caplog.records] == [missing] * needed
    for count, word in enumerate((b"first", b"second"), 1):
        device = adapters.plug(link)
        await listener.until(opened=count)
        os.write(adapters.masters[device], word)
        await listener.until(data=word)
        adapters.pull(device)
        await until(lambda: not port.connected)
        assert listener.lost == [device] * count
    port.close()
    warnings = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert sum("is gone" in text for text in warnings) == 2


@pytest.mark.io
async def test_gateway_without_receiver_opens_no_port(
    listener: Listener, caplog: pytest.LogCaptureFixture
) -> None:
    link = listener.port("none")
    link.start()
    assert (link.status([]).state, link.connected, caplog.records) == ("closed", False, [])


@pytest.mark.io
async def test_retries_back_off_and_the_reason_is_logged_once(
    listener: Listener, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The delays double up to a second: a port that is back for long is found at once."""
    loop = asyncio.get_running_loop()
    delays: list[float] = []
    pending: list = []

    def call_later(delay: float, callback: object) -> asyncio.TimerHandle:
        delays.append(delay)
        pending.append(callback)
        return asyncio.TimerHandle(0.0, lambda: None, (), loop)

    monkeypatch.setattr(loop, "call_later", call_later)
    link = listener.port("/dev/does-not-exist")
    link.start()
    for _ in range(7):
        pending.pop()()
    assert delays == [0.25, 0.5, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0]
    assert delays[-1] == LONGEST_RETRY_S
    assert len(caplog.records) == 1
    link.close()


@pytest.mark.io
@pytest.mark.parametrize("can", [True, False], ids=["supported", "unsupported"])
async def test_low_latency_of_the_adapter_is_requested(
    adapters: Adapters,
    listener: Listener,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    can: bool,
) -> None:
    asked: list[bool] = []

    def ask(_: object, wanted: bool) -> None:
        asked.append(wanted)
        if not can:
            raise ValueError("Failed to update ASYNC_LOW_LATENCY flag")

    monkeypatch.setattr("serial.Serial.set_low_latency_mode", ask)
    link = listener.port(adapters.plug())
    link.start()
    assert (asked, link.connected) == ([True], True)
    assert not caplog.records, "an adapter that cannot is used as it is, without a word"
    link.close()


def test_backlog_is_read_at_the_rate_of_the_line(listener: Listener) -> None:
    """Samples are lost where turns of the loop are long and each reads no more than one sample."""
    times_us = (0, 300, 40_300, 40_600, 60_600, 90_000)
    link = listener.port(now_us=iter(times_us).__next__)
    line, end = os.pipe()
    os.set_blocking(line, False)
    os.write(end, bytes(3000))
    for _ in times_us:
        link._read(line)
    os.close(line)
    os.close(end)
    # 40 ms of the line are 2000 bytes; the last two reads find the rest, and nothing.
    assert listener.sizes == [48, 48, 2000, 48, 856]


FRAME = encode_frame(bytes(range(1, 40)))
NOISE = bytes([0x55, 0x00, 0xFF]) * 40
"""Bytes of another device, delimiters included."""


async def found_receiver(adapters: Adapters, listener: Listener, receiver: str) -> SerialPort:
    """Open a port that searches, and send frames to one adapter until it is found."""
    port = listener.port()
    port.start()

    def sent() -> int:
        # Opening discards what was received before.
        with contextlib.suppress(BlockingIOError):
            os.write(adapters.masters[receiver], FRAME)
        return listener.opened

    await until(sent)
    return port


@pytest.mark.io
async def test_receiver_is_found_among_adapters_by_its_frames(
    adapters: Adapters, listener: Listener
) -> None:
    silent, noisy, receiver = (adapters.plug() for _ in range(3))
    os.write(adapters.masters[noisy], NOISE)
    port = await found_receiver(adapters, listener, receiver)
    assert listener.devices == [receiver]
    await listener.until(data=FRAME)
    # The others are free for other programs.
    for device in (silent, noisy):
        serial.Serial(device, timeout=0, exclusive=True).close()
    port.close()


@pytest.mark.io
@pytest.mark.usefixtures("fast_retry")
async def test_silent_adapter_is_not_taken_when_the_receiver_is_pulled(
    adapters: Adapters, listener: Listener, caplog: pytest.LogCaptureFixture
) -> None:
    silent, receiver = adapters.plug(), adapters.plug()
    port = await found_receiver(adapters, listener, receiver)
    adapters.pull(receiver)
    await until(lambda: f"no receiver among {silent}" in caplog.text)
    assert listener.devices == [receiver]
    again = adapters.plug()
    await listener.until(opened=2)
    assert listener.devices == [receiver, again]
    port.close()


@pytest.mark.io
async def test_no_receiver_among_several_adapters_is_reported_with_each_answer(
    adapters: Adapters, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gateway.live.serial_port.ASK_S", 0.2)
    silent, noisy, held = (adapters.plug() for _ in range(3))
    open_port = serial_port.open_port

    def open_and_send(device: str, baud: int, ports: list[Port]) -> serial.Serial:
        port = open_port(device, baud, ports)
        if device == noisy:
            # Not before: opening discards what was received.
            os.write(adapters.masters[noisy], NOISE)
            assert select.select([port], [], [], 60.0)[0]
        return port

    monkeypatch.setattr(serial_port, "open_port", open_and_send)
    in_use = serial.Serial(held, timeout=0, exclusive=True)
    with in_use, pytest.raises(PortNotFoundError) as raised:
        await find_receiver(SerialSettings(port="auto"))
    for text in (
        f"{silent}: sends nothing",
        f"{noisy}: sends no frames at 500000 baud",
        f"{held}: another program has it open",
    ):
        assert text in str(raised.value)


@pytest.mark.io
async def test_serial_port_is_changed_closed_and_opened_again(
    adapters: Adapters, listener: Listener, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gateway.live.control_verbs.list_serial_ports", adapters.ports)
    first, second = adapters.plug(), adapters.plug()
    port = listener.port(first)
    server = ControlServer(tmp_path / "s", serial_verbs(port, is_simulated=False))
    port.start()
    status = (await ask(server, "serial.status"))["result"]
    assert (status["state"], status["device"], len(status["ports"])) == ("open", first, 2)
    moved = (await ask(server, "serial.connect", port=second))["result"]
    assert (moved["state"], moved["wanted"], moved["device"]) == ("open", second, second)
    assert listener.lost == [first, second]
    # The first is free for other programs.
    serial.Serial(first, timeout=0, exclusive=True).close()
    for path in ("/dev/watchdog", "/etc/passwd", "", "usb:1a86:7523"):
        refused = await ask(server, "serial.connect", port=path)
        assert "is not a serial port here" in refused["error"]
    closed = (await ask(server, "serial.disconnect"))["result"]
    assert (closed["state"], closed["device"], port.connected) == ("closed", "", False)
    adapters.pull(first)
    waiting = (await ask(server, "serial.connect", port=first))["result"]
    assert (waiting["state"], waiting["wanted"]) == ("waiting", first)
    assert "No such file or directory" in waiting["reason"]
    assert (await ask(server, "serial.connect", port="auto"))["result"]["device"] == second
    assert (await ask(server, "serial.disconnect"))["result"]["state"] == "closed"
    simulated = ControlServer(tmp_path / "s", serial_verbs(port, is_simulated=True))
    assert (await ask(simulated, "serial.status"))["result"]["is_fixed"]
    for verb, params in (("serial.connect", {"port": "auto"}), ("serial.disconnect", {})):
        assert "simulated" in (await ask(simulated, verb, **params))["error"]
