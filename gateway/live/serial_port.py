"""The receiver's serial port: found by name, USB id or its frames, and opened again after a loss.

| state     | event                          | next                                      |
| --------- | ------------------------------ | ----------------------------------------- |
| waiting   | the timer fires, one port fits | tries to open: `open`, or waits longer    |
| waiting   | the timer fires, several fit   | opens all of them: `asking`               |
| asking    | a port sends a valid frame     | the others are closed: `open`             |
| asking    | `ASK_S` without any frame      | closes all: `waiting`                     |
| open      | bytes are there                | passed on, with the time of reading       |
| open      | the port fails or is pulled    | closed: `waiting`, shortest delay         |
"""

import asyncio
import contextlib
import errno
import logging
import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Final, Literal

import serial
from msgspec.structs import replace
from serial.tools import list_ports

from gateway.printable import NO_RECEIVER, UserError, reason_of
from gateway.settings import Settings, setting
from gateway.units import BITS_PER_BYTE, US_PER_S
from gateway.wire.framing import Fault, FrameDecoder

log = logging.getLogger(__name__)

FIRST_RETRY_S: Final = 0.25
LONGEST_RETRY_S: Final = 1.0
"""Longest delay of retries: a port that returns and is lost again within it would be missed."""
READ_SIZE: Final = 48
"""Bytes of one read; a sample of the IMU has 42. So a backlog, of which the kernel keeps 4096
bytes, takes several turns of the loop: clients need not wait, and the hub's queue drains. With 256
bytes it does not, and telemetry that has waited too long is dropped."""

ASK_S: Final = 6.0
"""Time for which adapters are tried: opening a port resets a board, whose bootloader waits up to
2 s; then the receiver reports at least once a second."""
ASK_AGAIN_S: Final = 30.0
"""Pause before adapters that sent no frame are opened again."""
READ_ASKED: Final = 4096

KNOWN_ADAPTERS: Final = {
    (0x0403, 0x6001): "FTDI FT232R",
    (0x0403, 0x6015): "FTDI FT230X",
    (0x067B, 0x2303): "Prolific PL2303",
    (0x10C4, 0xEA60): "Silicon Labs CP210x",
    (0x1A86, 0x5523): "WCH CH341",
    (0x1A86, 0x7523): "WCH CH340",
    (0x2341, 0x0043): "Arduino Uno",
    (0x2341, 0x0001): "Arduino Uno",
}
"""USB serial chips of Arduino-class boards and programming cables."""
AUTO: Final = "auto"
"""Setting `port` that selects a known USB adapter, or several that are tried."""


class SerialSettings(Settings, frozen=True):
    """Serial port of the receiver."""

    port: Annotated[
        str,
        setting(
            'Port of the receiver: a device ("/dev/ttyUSB0"), a USB id with or without its serial '
            'number ("usb:1a86:7523", "usb:0403:6001:A50285BI"), "auto" for a known USB adapter, '
            'or "none" for a router without one. With other sources among the endpoints, "auto" '
            "does not report a missing receiver. If several adapters fit, each is opened and "
            "checked for frames, which resets its board. `mavgate doctor` lists them.",
            pattern=r"^(auto|none|/.+|usb:[0-9a-fA-F]{4}:[0-9a-fA-F]{4}(:.+)?)$",
        ),
    ] = AUTO
    baud: Annotated[
        int,
        setting("Speed of the line; the receiver's firmware must match.", "baud", ge=9600, le=2e6),
    ] = 500_000


class PortNotFoundError(UserError):
    """No port fits the setting, or it cannot be opened; the text gives the reason and the ports."""


@dataclass(frozen=True, slots=True)
class Port:
    """One serial port of this machine."""

    device: str
    usb_id: str
    serial_number: str
    description: str
    known: bool


@dataclass(frozen=True, slots=True)
class SerialStatus:
    """The receiver's port at one moment."""

    state: Literal["open", "waiting", "closed"]
    wanted: str
    """The requested port, as in the setting `port`."""
    device: str
    """The open port; empty if none is."""
    reason: str
    """The reason why it is not open yet."""
    ports: tuple[Port, ...]
    """All ports of this machine."""
    is_fixed: bool = False
    """Whether the receiver is simulated: its port cannot be changed."""


def list_serial_ports() -> list[Port]:
    """List the serial ports of this machine, those on known USB adapters first."""
    ports = [
        Port(
            device=p.device,
            usb_id="" if p.vid is None else f"{p.vid:04x}:{p.pid:04x}",
            serial_number=p.serial_number or "",
            description=KNOWN_ADAPTERS.get((p.vid, p.pid)) or p.product or p.description or "",
            known=(p.vid, p.pid) in KNOWN_ADAPTERS,
        )
        for p in list_ports.comports()
    ]
    return sorted(ports, key=lambda port: (not port.known, port.device))


def fitting_ports(wanted: str, ports: list[Port]) -> list[str]:
    """List the devices that the setting `port` may mean, of the ports of this machine.

    Raises PortNotFoundError if there is none.
    """
    if wanted == NO_RECEIVER:
        raise PortNotFoundError("serial.port = none: no receiver is used")
    if wanted == AUTO:
        fitting = [port for port in ports if port.known]
    elif wanted.startswith("usb:"):
        vid, pid, *serial_number = wanted.removeprefix("usb:").lower().split(":", 2)
        fitting = [
            port
            for port in ports
            if port.usb_id == f"{vid}:{pid}"
            and (not serial_number or port.serial_number.lower() == serial_number[0])
        ]
    else:
        return [wanted]
    if not fitting:
        raise PortNotFoundError(f"no port fits {wanted!r}; this machine has {_listed(ports)}")
    return [port.device for port in fitting]


def find_port(wanted: str, ports: list[Port]) -> str:
    """Return the only device of `fitting_ports`; raises PortNotFoundError if there are several."""
    fitting = fitting_ports(wanted, ports)
    if len(fitting) > 1:
        raise PortNotFoundError(
            f"several USB adapters fit: {', '.join(fitting)}; name one with --port"
        )
    return fitting[0]


def _listed(ports: list[Port]) -> str:
    return ", ".join(f"{p.device} ({p.usb_id or 'no USB'})" for p in ports) or "no port at all"


def why_not_open(error: Exception, ports: list[Port]) -> str:
    """Describe an error of pyserial, and name the adapters that this machine has instead."""
    number = getattr(error, "errno", None)
    if number == errno.EAGAIN:
        return "another program has it open"
    if number is None and isinstance(error, serial.SerialException):
        return "not a serial port"
    known = ports if number == errno.ENOENT else []
    others = [f"{p.device} is there, always found as usb:{p.usb_id}" for p in known if p.known]
    return "; ".join([reason_of(error), *others])


def open_port(device: str, baud: int, ports: list[Port]) -> serial.Serial:
    """Open the receiver's port, for this program alone; raises PortNotFoundError."""
    try:
        return serial.Serial(device, baud, timeout=0, write_timeout=0, exclusive=True)
    except (OSError, ValueError) as error:
        raise PortNotFoundError(f"serial port {device}: {why_not_open(error, ports)}") from error


async def search_receiver(devices: list[str], baud: int) -> tuple[serial.Serial, bytes]:
    """Open several ports; return the one that sends the receiver's frames, and the bytes read last.

    Raises PortNotFoundError if none sends a frame within `ASK_S`; its text describes each.
    """
    loop = asyncio.get_running_loop()
    found: asyncio.Future[tuple[str, bytes]] = loop.create_future()
    asked, answers = _open_each(devices, baud)
    decoders = {device: FrameDecoder() for device in asked}

    def read(device: str) -> None:
        if found.done():
            return
        try:
            data = asked[device].read(READ_ASKED)
        except OSError:
            answers[device] = f"{device}: gone"
            loop.remove_reader(asked[device].fileno())
            return
        answers[device] = f"{device}: sends no frames at {baud} baud"
        if not all(isinstance(event, Fault) for event in decoders[device].feed(data)):
            found.set_result((device, data))

    for device, port in asked.items():
        loop.add_reader(port.fileno(), read, device)
    receiver = ""
    try:
        async with asyncio.timeout(ASK_S):
            receiver, data = await found
    except TimeoutError:
        text = f"several USB adapters fit, and none is the receiver: {'; '.join(answers.values())}"
        raise PortNotFoundError(text) from None
    finally:
        for device, port in asked.items():
            loop.remove_reader(port.fileno())
            if device != receiver:
                port.close()
    return asked[receiver], data


def _open_each(devices: list[str], baud: int) -> tuple[dict[str, serial.Serial], dict[str, str]]:
    """Open the ports that can be opened, and describe each so far."""
    opened, answers, ports = {}, {}, list_serial_ports()
    for device in devices:
        answers[device] = f"{device}: sends nothing"
        try:
            opened[device] = open_port(device, baud, ports)
        except PortNotFoundError as error:
            answers[device] = str(error).removeprefix("receiver ")
    return opened, answers


async def find_receiver(settings: SerialSettings) -> str:
    """Return the device of the receiver; if several ports fit the settings, all are tried.

    Raises PortNotFoundError if no port fits, none is the receiver, or the only one does not open.
    """
    ports = list_serial_ports()
    fitting = fitting_ports(settings.port, ports)
    if len(fitting) == 1:
        port = open_port(fitting[0], settings.baud, ports)
    else:
        port, _ = await search_receiver(fitting, settings.baud)
    port.close()
    return str(port.port)


class SerialPort:
    """Keep one serial port open and pass on its bytes.

    A port that is not needed may be missing without a warning.

    `on_bytes` is called with every chunk and the gateway time of its reading; `on_open` and
    `on_lost` with the device, after each opening, before the first bytes, and after each loss.
    """

    def __init__(
        self,
        settings: SerialSettings,
        on_bytes: Callable[[bytes, int], None],
        on_open: Callable[[str], None],
        on_lost: Callable[[str], None],
        now_us: Callable[[], int],
        *,
        needed: bool = True,
    ) -> None:
        self._settings = settings
        self._needed = needed
        self._on_bytes = on_bytes
        self._on_open = on_open
        self._on_lost = on_lost
        self._now_us = now_us
        self._port: serial.Serial | None = None
        self._retry: asyncio.TimerHandle | None = None
        self._delay_s = FIRST_RETRY_S
        self._last_warning = ""
        self._search: asyncio.Task[None] | None = None
        self._rejected: set[str] = set()
        """Ports that were tried and are not the receiver."""
        self._tried_s = 0.0
        self._read_us = 0
        self._left_more = False

    @property
    def connected(self) -> bool:
        """Whether the port is open; a receiver behind it may send nothing."""
        return self._port is not None

    def start(self) -> None:
        """Open the port, now or as soon as it exists."""
        self._open()

    def close(self) -> None:
        """Close the port without another attempt to open it."""
        if self._retry is not None:
            self._retry.cancel()
            self._retry = None
        if self._search is not None:
            self._search.cancel()
            self._search = None
        self._release()

    async def connect(self, wanted: str) -> None:
        """Close the port, and open the one named as in the setting `port`, once it exists."""
        await self.disconnect()
        self._settings = replace(self._settings, port=wanted)
        self._delay_s = FIRST_RETRY_S
        self._last_warning = ""
        self._rejected.clear()
        self._on_lost(wanted)
        self._open()

    async def disconnect(self) -> None:
        """Close the port until `connect` is called."""
        device = None if self._port is None else str(self._port.port)
        search = self._search
        self.close()
        if search is not None:
            await asyncio.wait([search])
        if device is not None:
            self._on_lost(device)

    def status(self, ports: list[Port]) -> SerialStatus:
        """Return the state of the port; `ports` are those of this machine."""
        is_trying = self._retry is not None or self._search is not None
        state: Literal["open", "waiting", "closed"] = "waiting" if is_trying else "closed"
        return SerialStatus(
            "open" if self.connected else state,
            self._settings.port,
            "" if self._port is None else str(self._port.port),
            self._last_warning if is_trying else "",
            tuple(ports),
        )

    def _open(self) -> None:
        self._retry = None
        if self._settings.port == NO_RECEIVER:
            return
        ports = list_serial_ports()
        try:
            fitting = self._candidates(ports)
            if len(fitting) > 1:
                log.info("several USB adapters fit, trying each: %s", ", ".join(fitting))
                self._search = asyncio.get_running_loop().create_task(self._ask(fitting))
                return
            port = open_port(fitting[0], self._settings.baud, ports)
        except PortNotFoundError as error:
            self._warn_once(str(error))
            self._try_later()
            return
        self._use(port)

    def _candidates(self, ports: list[Port]) -> list[str]:
        """List the ports that may be the receiver, without those that were tried lately."""
        fitting = fitting_ports(self._settings.port, ports)
        if asyncio.get_running_loop().time() - self._tried_s > ASK_AGAIN_S:
            self._rejected.clear()
        self._rejected &= {*fitting}  # one that was unplugged may return as another
        if left := [device for device in fitting if device not in self._rejected]:
            return left
        raise PortNotFoundError(
            f"no receiver among {', '.join(fitting)}, which are tried again every "
            f"{ASK_AGAIN_S:.0f} s; plug it in, or name its port in [serial] port or with --port"
        )

    async def _ask(self, devices: list[str]) -> None:
        try:
            port, data = await search_receiver(devices, self._settings.baud)
        except PortNotFoundError as error:
            self._rejected = {*devices}
            self._warn_once(str(error))
            self._try_later()
        else:
            self._rejected = {*devices} - {port.port}
            self._use(port)
            self._on_bytes(data, self._now_us())
        self._search = None
        self._tried_s = asyncio.get_running_loop().time()

    def _use(self, port: serial.Serial) -> None:
        self._port, device = port, str(port.port)
        with contextlib.suppress(OSError, ValueError):
            # An adapter may delay bytes to send more at once, FTDI's by 16 ms.
            port.set_low_latency_mode(True)
        log.info("receiver on %s at %d baud", device, self._settings.baud)
        self._needed = True
        self._delay_s = FIRST_RETRY_S
        self._last_warning = ""
        self._on_open(device)
        file = port.fileno()
        asyncio.get_running_loop().add_reader(file, self._read, file)

    def _read(self, file: int) -> None:
        now_us, size = self._now_us(), READ_SIZE
        if self._left_more:
            # As many bytes as the line has carried since: while clients make turns long, samples
            # are late, but none is lost in the kernel.
            line_bytes = (now_us - self._read_us) * self._settings.baud // BITS_PER_BYTE
            size = max(READ_SIZE, line_bytes // US_PER_S)
        try:
            # pyserial's own read would make two more system calls for every sample.
            data = os.read(file, size)
        except BlockingIOError:
            return
        except OSError as error:
            self._broke(error)
            return
        self._read_us, self._left_more = now_us, len(data) == size
        if data:
            self._on_bytes(data, now_us)
        else:
            self._broke(OSError("the device hung up"))

    def _broke(self, error: OSError) -> None:
        assert self._port is not None
        device = str(self._port.port)
        self._warn_once(f"receiver {device} is gone: {reason_of(error)}")
        self._release()
        self._on_lost(device)
        self._try_later()

    def _release(self) -> None:
        if self._port is None:
            return
        asyncio.get_running_loop().remove_reader(self._port.fileno())
        self._port.close()
        self._port = None

    def _try_later(self) -> None:
        self._retry = asyncio.get_running_loop().call_later(self._delay_s, self._open)
        self._delay_s = min(2.0 * self._delay_s, LONGEST_RETRY_S)

    def _warn_once(self, text: str) -> None:
        """Log a problem once, even if it is repeated."""
        if text != self._last_warning:
            if self._needed:
                log.warning("%s; trying again until it works", text)
            self._last_warning = text
