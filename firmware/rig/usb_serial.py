"""A board's USB serial adapter as a pseudo-terminal, for programs such as avrdude.

An adapter resets the board when a program opens it, by the DTR line, which a pseudo-terminal lacks:
so opening is detected instead. Bytes at another speed than the chip's are lost, and simulated time
never runs ahead of true time, because bootloaders and avrdude have timeouts.
"""

import contextlib
import ctypes
import functools
import itertools
import os
import pty
import select
import subprocess
import termios
import time
import tty
from pathlib import Path
from typing import Final

from firmware.rig.bench import PS_PER_S
from firmware.rig.boards import Board, Receiver
from firmware.rig.mcu import EXTERNAL, FIRMWARE

BOOTLOADERS: Final = Path("/usr/share/arduino/hardware/arduino/avr/bootloaders")
"""Of the Debian package arduino-core-avr; `make -C firmware optiboot` compiles the new one."""
NEW_BOOTLOADER: Final = FIRMWARE / "build" / "optiboot"
OLD_BOOTLOADER: Final = BOOTLOADERS / "atmega" / "ATmegaBOOT_168_atmega328"
"""Of a Nano: programs for a board's `program`, without `.hex`."""

PIECE_S: Final = 0.001
READ_SIZE: Final = 256
BITS_PER_BYTE: Final = 10
SPEED_TOLERANCE: Final = 0.04
SKIPPED_NUMBERS: Final = 48
_IN_OPEN: Final = 0x20
"""Linux `inotify`: the file was opened."""
SPEEDS: Final = {
    getattr(termios, f"B{baud}"): baud for baud in (9600, 19200, 57600, 115200, 500_000)
}


class UsbSerial:
    """The pseudo-terminal of one board.

    Parameters
    ----------
    board : Board
        Runs on the bench of its setup, with all that is on it.
    """

    def __init__(self, board: Board) -> None:
        self._board = board
        self._bench = board.setup.bench
        self._take = board.take_bytes if isinstance(board, Receiver) else board.mcu.uart_take
        self._master, self._slave = _seldom_used_pty()
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)
        os.set_blocking(self._master, False)
        self._poll = select.poll()
        self._poll.register(self._master, select.POLLIN)
        libc = ctypes.CDLL(None)
        self._opened = libc.inotify_init1(os.O_NONBLOCK)
        libc.inotify_add_watch(self._opened, self.path.encode(), _IN_OPEN)
        self._line_free_ps = 0
        self._opening = 0
        self._ahead_of_s = 0.0

    def close(self) -> None:
        """Remove the pseudo-terminal."""
        for file in (self._opened, self._slave, self._master):
            os.close(file)

    def run_while(self, process: subprocess.Popen[str], limit_s: float) -> int:
        """Run this board until a program that uses the port has ended; returns its exit code.

        The other boards are halted meanwhile, so that this one keeps up with true time.

        Raises
        ------
        TimeoutError
            If it takes longer than `limit_s` of simulated time.
        """
        # The bench may have run alone meanwhile.
        self._ahead_of_s = time.monotonic() - self._bench.now_ps / PS_PER_S
        end_ps = self._bench.now_ps + round(limit_s * PS_PER_S)
        chips, self._bench.chips = self._bench.chips, [self._board.mcu]
        try:
            while process.poll() is None:
                if self._bench.now_ps > end_ps:
                    process.kill()
                    raise TimeoutError(f"{process.args} runs for more than {limit_s} s")
                self.run(PIECE_S)
        finally:
            self._bench.chips = chips
            for chip in chips:
                chip.halt(self._bench.now_ps)
        return process.returncode

    def run(self, seconds: float) -> None:
        """Pass the bytes of both directions, and run the bench on."""
        self._hear()
        self._bench.run_for(seconds)
        sent = bytes(byte for _, byte in self._take())
        if sent and self._same_speed():
            with contextlib.suppress(BlockingIOError):  # nobody reads: an adapter drops them too
                os.write(self._master, sent)
        ahead_s = self._bench.now_ps / PS_PER_S + self._ahead_of_s - time.monotonic()
        if ahead_s > 0:
            time.sleep(ahead_s)
        else:
            self._ahead_of_s -= ahead_s  # a slow machine does not catch up

    def _hear(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.read(self._opened, READ_SIZE)
            self._open_anew()
        if not dict(self._poll.poll(0)).get(self._master, 0) & select.POLLIN:
            return
        data = os.read(self._master, READ_SIZE)
        if not self._same_speed():
            return
        byte_ps = round(BITS_PER_BYTE * PS_PER_S / self._board.mcu.uart_baud)
        self._line_free_ps = max(self._line_free_ps, self._bench.now_ps)
        for byte in data:
            self._bench.at(self._line_free_ps, functools.partial(self._feed, byte, self._opening))
            self._line_free_ps += byte_ps

    def _open_anew(self) -> None:
        """Reset the board, and drop the bytes of the last program in both directions."""
        termios.tcflush(self._slave, termios.TCIFLUSH)
        with contextlib.suppress(BlockingIOError):
            while os.read(self._master, READ_SIZE):
                pass
        self._opening += 1
        self._board.reset(EXTERNAL)

    def _feed(self, byte: int, opening: int) -> None:
        if opening == self._opening:
            self._board.mcu.uart_feed(byte)

    def _same_speed(self) -> bool:
        host = SPEEDS.get(termios.tcgetattr(self._master)[4], 0)
        return abs(self._board.mcu.uart_baud - host) <= SPEED_TOLERANCE * host


def _seldom_used_pty() -> tuple[int, int]:
    """Open a pseudo-terminal of a high number.

    The lowest free number may be that of a receiver which a gateway on this machine still tries to
    open again.
    """
    opened = [pty.openpty() for _ in range(SKIPPED_NUMBERS + os.getpid() % SKIPPED_NUMBERS)]
    for file in itertools.chain.from_iterable(opened[:-1]):
        os.close(file)
    return opened[-1]
