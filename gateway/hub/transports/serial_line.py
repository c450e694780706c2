"""MAVLink on a serial port: a telemetry radio to the ground, or an autopilot.

The line is slow, so frames wait in our queue and not in the driver's, where an attitude could not
overtake a parameter list. pyserial opens and configures; reading and writing go to the descriptor,
since pyserial spins on a full buffer.
"""

import asyncio
import logging
import math
import os
from typing import Final

import serial

from gateway.hub.transports.stream import QueuedClient
from gateway.units import BITS_PER_BYTE, US_PER_S
from gateway.wire.mavlink_messages import MESSAGE_IDS
from gateway.wire.mavlink_splitter import MavFrame

log = logging.getLogger(__name__)

READ_BYTES: Final = 4096
AHEAD_US: Final = 30_000
"""Maximum content of the driver's buffer as time on the line: keeps it busy between wake-ups."""
QUEUE_US: Final = US_PER_S
"""Size of the queue as time on the line; older telemetry is of no use on a radio."""
MIN_QUEUE_BYTES: Final = 2048


class Pacer:
    """Keep the driver's buffer of a serial line short, so that urgent frames need not wait for it.

    A driver accepts kilobytes at once, which at 57600 Bd is most of a second. The pacer computes
    when the line of `baud` will have sent them, and allows the next frame `ahead_us` before.
    """

    def __init__(self, baud: int, ahead_us: int) -> None:
        self._baud = baud
        self._ahead_us = ahead_us
        self._free_us = 0

    def delay_us(self, now_us: int) -> int:
        """Return the time until the next frame may be written; 0 is now."""
        return max(0, self._free_us - self._ahead_us - now_us)

    def wrote(self, size: int, now_us: int) -> None:
        """Account for bytes written to the driver."""
        busy_us = math.ceil(size * BITS_PER_BYTE * US_PER_S / self._baud)
        self._free_us = max(self._free_us, now_us) + busy_us


class SerialClient(QueuedClient):
    """A peer on a serial port that may come and go."""

    _port: serial.Serial | None = None
    _timer: asyncio.TimerHandle | None = None

    def __post_init__(self) -> None:
        """Start without a port."""
        super().__post_init__()
        self._pacer = Pacer(self.endpoint.port, AHEAD_US)

    @property
    def queue_bytes(self) -> int:
        """Maximum bytes that wait for the line."""
        bytes_per_s = self.endpoint.port / BITS_PER_BYTE
        return max(MIN_QUEUE_BYTES, round(bytes_per_s * QUEUE_US / US_PER_S))

    def transmit(self, frame: MavFrame) -> None:
        """Queue one frame and write the frames for which the line has room."""
        if self._port is None:
            self.counters.dropped += 1
            return
        self._push(frame)
        if self._timer is None and not self._partial:
            self._pump()

    def tick(self, now_us: int) -> None:
        """Open the port again if it is gone."""
        if self._port is not None or not self._is_retry_due(now_us):
            return
        try:
            port = self._open()
        except (OSError, ValueError) as error:
            self.become("unreachable", error)
            return
        self._port = port
        self.memory.input, self.memory.is_forwardable = port.fileno(), 1
        self._splitter.reset()
        self.become("open")
        self.loop.add_reader(port.fileno(), self._on_readable, port)
        self.context.greet(self.client_id)

    def _open(self) -> serial.Serial:
        """Open the port; raises OSError or ValueError."""
        device, baud = self.endpoint.host, self.endpoint.port
        return serial.Serial(device, baud, timeout=0, write_timeout=0, exclusive=True)

    def receive_frame(self, frame: MavFrame, now_us: int) -> None:
        """Route one frame; those of the radio report the room in its buffer."""
        if frame.message_id == MESSAGE_IDS["RADIO_STATUS"]:
            self.context.update_buffer(self.client_id, frame.free_percent)
        super().receive_frame(frame, now_us)

    def close(self) -> None:
        """Close the port; waiting frames are lost."""
        self.memory.input = -1
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._port is not None:
            self.loop.remove_reader(self._port.fileno())
            self.loop.remove_writer(self._port.fileno())
            self._port.close()
            self._port = None
        self._drop_all()

    def _broke(self, error: OSError) -> None:
        log.warning("%s is gone: %s", self.endpoint.host, error)
        self.close()
        self.become("unreachable", error)

    def _pump(self) -> None:
        """Write until the line is busy for a while or nothing waits."""
        self._timer = None
        port = self._port
        while port is not None and self._port is port and (self._partial or self._queue):
            delay_us = self._pacer.delay_us(self.context.now_us())
            if delay_us:
                self._timer = self.loop.call_later(delay_us / US_PER_S, self._pump)
                return
            if not self._write(port):
                return

    def _write(self, port: serial.Serial) -> bool:
        """Write one frame; if the driver is full, wait for it."""
        now_us = self.context.now_us()
        if not self._partial:
            self._drop(self._queue.expire(now_us - QUEUE_US))
            self._partial = self._queue.pop(now_us) or b""
            if not self._partial:
                return False
        try:
            taken = os.write(port.fileno(), self._partial)
        except BlockingIOError:
            taken = 0
        except OSError as error:
            self._broke(error)
            return False
        self.counters.bytes_sent += taken
        self._pacer.wrote(taken, now_us)
        self._partial = self._partial[taken:]
        if self._partial:
            self.loop.add_writer(port.fileno(), self._on_writable, port)
        return not self._partial

    def _on_writable(self, port: serial.Serial) -> None:
        self.loop.remove_writer(port.fileno())
        self._pump()

    def _on_readable(self, port: serial.Serial) -> None:
        try:
            data = os.read(port.fileno(), min(READ_BYTES, self.context.read_bytes))
        except BlockingIOError:
            return
        except OSError as error:
            self._broke(error)
            return
        if data:
            self.feed(data, self.context.now_us())
        else:
            self._broke(OSError("the device hung up"))
