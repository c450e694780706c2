"""SX1276 at its registers: the LoRa modem with explicit headers.

Times and rules are those of the datasheet, revision 7; comments cite its sections.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from firmware.rig.air import Air, Transmission
from firmware.rig.bench import PS_PER_S, PS_PER_US, Bench

FIFO, OP_MODE, FRF_MSB = 0x00, 0x01, 0x06
FIFO_ADDR_PTR, FIFO_TX_BASE, FIFO_RX_BASE, FIFO_RX_CURRENT = 0x0D, 0x0E, 0x0F, 0x10
IRQ_FLAGS_MASK, IRQ_FLAGS, RX_NB_BYTES = 0x11, 0x12, 0x13
PKT_SNR, PKT_RSSI, RSSI, HOP_CHANNEL = 0x19, 0x1A, 0x1B, 0x1C
MODEM_CONFIG_1, MODEM_CONFIG_2 = 0x1D, 0x1E
PREAMBLE_LSB, PAYLOAD_LENGTH, SYNC_WORD = 0x21, 0x22, 0x39
DIO_MAPPING_1, VERSION = 0x40, 0x42
_RESET_VALUES: Final = {
    OP_MODE: 0x09, 0x06: 0x6C, 0x07: 0x80, 0x08: 0x00, 0x09: 0x4F, 0x0A: 0x09, 0x0B: 0x2B,
    0x0C: 0x20, FIFO_TX_BASE: 0x80, MODEM_CONFIG_1: 0x72, MODEM_CONFIG_2: 0x70, 0x1F: 0x64,
    PREAMBLE_LSB: 0x08, PAYLOAD_LENGTH: 0x01, 0x23: 0xFF, 0x31: 0xC3, 0x37: 0x0A,
    SYNC_WORD: 0x12, 0x4D: 0x84,
}  # fmt: skip
"""Table 41."""
RX_DONE, CRC_ERROR, TX_DONE, CAD_DONE, CAD_DETECTED = 1 << 6, 1 << 5, 1 << 3, 1 << 2, 1 << 0
_DIO0: Final = {0: RX_DONE, 1: TX_DONE, 2: CAD_DONE}
"""Table 18: the flag on DIO0 by the two upper bits of its mapping."""
_LORA: Final = 0x80
SLEEP, STANDBY, SEND, RECEIVE, DETECT = 0, 1, 3, 5, 7
_MODE: Final = 0x07
_WRITE: Final = 0x80
_FIFO_SIZE: Final = 256
_BURST: Final = 64
_SENDING_PS: Final = 120 * PS_PER_US
_RECEIVING_PS: Final = 100 * PS_PER_US
"""From standby to sending or receiving: table 7, with the synthesiser's 60 us."""
_BANDWIDTHS_KHZ: Final = {7: 125, 8: 250, 9: 500}
_CRYSTAL_HZ: Final = 32_000_000
_LOW_BANDS_END_KHZ: Final = 525_000
CAPTURE_DB: Final = 6.0
"""Co-channel rejection: table 10."""
NOISE_FIGURE_DB: Final = 6.0
SNR_LIMIT_DB: Final = {7: -7.5, 8: -10.0, 9: -12.5, 10: -15.0}
"""By spreading factor: table 13."""
MOST_SNR_DB: Final = 10.0
"""The chip reports no more, however strong a packet is."""


@dataclass(frozen=True, slots=True)
class LoraPacket:
    """A LoRa transmission."""

    frequency_khz: int
    spreading: int
    bandwidth_khz: int
    coding: int
    sync_word: int
    payload: bytes
    strength_db: float = -80.0
    """As received, dBm."""
    crc_on: bool = True

    @property
    def channel(self) -> tuple[int, int, int]:
        """Packets of other spreading factors are orthogonal, and do not disturb it."""
        return self.frequency_khz, self.spreading, self.bandwidth_khz

    @property
    def symbol_ps(self) -> int:
        """Time of one symbol."""
        return (PS_PER_S << self.spreading) // (1000 * self.bandwidth_khz)

    @property
    def duration_ps(self) -> int:
        """Section 4.1.1.7, with explicit header, CRC and a preamble of 8 symbols."""
        bits = 8 * len(self.payload) - 4 * self.spreading + 28 + 16 * self.crc_on
        groups = math.ceil(bits / (4 * self.spreading))
        return round((8 + 4.25 + 8 + max(groups * self.coding, 0)) * self.symbol_ps)

    @property
    def capture_db(self) -> float:
        """It survives a packet that is weaker by this."""
        return CAPTURE_DB

    @property
    def snr_db(self) -> float:
        """Above the thermal noise of its bandwidth and the receiver's."""
        noise_dbm = -174.0 + 10.0 * math.log10(1000.0 * self.bandwidth_khz) + NOISE_FIGURE_DB
        return self.strength_db - noise_dbm


class Sx1276:
    """One chip.

    Parameters
    ----------
    bench, air, board_now_ps : Bench, Air, callable
        As of `Nrf24`.
    set_irq : callable
        Drives DIO0; True is high, active.
    version : int
        Value of the version register; look-alikes have others than 0x12.
    """

    def __init__(
        self,
        bench: Bench,
        air: Air,
        board_now_ps: Callable[[], int],
        set_irq: Callable[[bool], None],
        version: int = 0x12,
    ) -> None:
        self._bench, self._air, self._version = bench, air, version
        self._board_now_ps, self._set_irq = board_now_ps, set_irq
        self.absent = False
        self.strength_db = -80.0
        """Of its packets where they are received, dBm."""
        air.listeners.append(self)
        self.power_cycle()

    def power_cycle(self) -> None:
        """Lose everything, as when the supply dips or the reset line falls."""
        self.registers = {**_RESET_VALUES, VERSION: self._version}
        self._fifo = bytearray(_FIFO_SIZE)
        self._command: int | None = None
        self._listening_ps: int | None = None
        self._job = 0
        self._drive_irq()

    # --- The pins -----------------------------------------------------------------------------

    def enable(self, nreset: bool) -> None:
        """Move the reset line."""
        if not nreset and not self.absent:
            self.power_cycle()

    def begin(self, command: int) -> tuple[int, bytes]:
        """Take an address byte; return the answers to it and to the bytes behind it."""
        if self.absent:
            return 0xFF, b"\xff" * _BURST
        self._command = command
        address = command & ~_WRITE
        if address == FIFO:
            start = self.registers.get(FIFO_ADDR_PTR, 0)
            return 0, bytes(self._fifo[(start + i) % _FIFO_SIZE] for i in range(_BURST))
        return 0, bytes(self._read(address + i) for i in range(_BURST))

    def deselect(self, data: bytes) -> None:
        """Raise NSS behind an address and its data: section 4.3."""
        if self._command is None:
            return
        command, self._command = self._command, None
        address = command & ~_WRITE
        if address == FIFO:
            start = self.registers.get(FIFO_ADDR_PTR, 0)
            if command & _WRITE:
                for i, byte in enumerate(data):
                    self._fifo[(start + i) % _FIFO_SIZE] = byte
            self.registers[FIFO_ADDR_PTR] = (start + len(data)) % _FIFO_SIZE
        elif command & _WRITE:
            for i, byte in enumerate(data):
                self._write(address + i, byte)

    # --- Registers ----------------------------------------------------------------------------

    def _read(self, address: int) -> int:
        if address == RSSI:
            busy = self._air.carrier(self._channel, self._board_now_ps())
            return self._rssi(-80.0 if busy else -115.0)
        return self.registers.get(address, 0)

    def _write(self, address: int, value: int) -> None:
        if address == IRQ_FLAGS:
            self.registers[IRQ_FLAGS] = self.registers.get(IRQ_FLAGS, 0) & ~value
            self._drive_irq()
        elif address == OP_MODE:
            self._write_mode(value)
        elif address not in (FIFO_RX_CURRENT, RX_NB_BYTES, PKT_SNR, PKT_RSSI, RSSI, VERSION):
            self.registers[address] = value
            if address == DIO_MAPPING_1:
                self._drive_irq()

    def _write_mode(self, value: int) -> None:
        if self.registers[OP_MODE] & _MODE != SLEEP:
            # LoRa is entered and left in sleep mode alone.
            value = value & ~_LORA | self.registers[OP_MODE] & _LORA
        self.registers[OP_MODE] = value
        self._job += 1
        self._listening_ps = None
        mode, now_ps = value & _MODE, self._board_now_ps()
        if not value & _LORA:
            return
        if mode == SEND:
            self._bench.at(now_ps + _SENDING_PS, self._of_job(self._send))
        elif mode == RECEIVE:
            self._listening_ps = now_ps + _RECEIVING_PS
        elif mode == DETECT:
            from_ps = now_ps + _RECEIVING_PS
            # Section 4.1.6: one symbol of reception, then the correlation.
            symbol_ps = self._packet(b"").symbol_ps
            done_ps = from_ps + symbol_ps + 32 * PS_PER_S // (1000 * self._bandwidth_khz)
            self._bench.at(done_ps, self._of_job(lambda: self._detected(from_ps, symbol_ps)))

    def _of_job(self, action: Callable[[], None]) -> Callable[[], None]:
        """Drop an action whose mode has been left meanwhile."""
        job = self._job
        return lambda: action() if job == self._job else None

    # --- Sending, detecting, receiving --------------------------------------------------------

    def _send(self) -> None:
        start = self.registers.get(FIFO_TX_BASE, 0)
        size = self.registers[PAYLOAD_LENGTH]
        payload = bytes(self._fifo[(start + i) % _FIFO_SIZE] for i in range(size))
        self._air.send(self._packet(payload), self, self._of_job(lambda: self._end(TX_DONE)))

    def _detected(self, from_ps: int, symbol_ps: int) -> None:
        busy = self._air.is_busy(self._channel, from_ps, from_ps + symbol_ps)
        self._end(CAD_DONE | (CAD_DETECTED if busy else 0))

    def _end(self, flags: int) -> None:
        self.registers[OP_MODE] = self.registers[OP_MODE] & ~_MODE | STANDBY
        self._raise(flags)

    def listens(self, packet: Transmission, start_ps: int) -> bool:
        """Whether it has been receiving such packets since `start_ps`."""
        since = self._listening_ps
        return (
            since is not None
            and since <= start_ps
            and isinstance(packet, LoraPacket)
            and packet.channel == self._channel
            and packet.sync_word == self.registers[SYNC_WORD]
            and packet.snr_db >= SNR_LIMIT_DB[packet.spreading]
        )

    def hear(self, packet: Transmission) -> None:
        """Take an undamaged packet: section 4.1.2.3."""
        assert isinstance(packet, LoraPacket)
        start = self.registers.get(FIFO_RX_BASE, 0)
        for i, byte in enumerate(packet.payload):
            self._fifo[(start + i) % _FIFO_SIZE] = byte
        self.registers[FIFO_RX_CURRENT] = start
        self.registers[RX_NB_BYTES] = len(packet.payload)
        snr_db = min(packet.snr_db, MOST_SNR_DB)
        self.registers[PKT_SNR] = round(4 * snr_db) & 0xFF
        # Section 5.5.5: below the noise the register holds the noise, to which the SNR is added.
        self.registers[PKT_RSSI] = self._rssi(packet.strength_db - min(snr_db, 0.0))
        self.registers[HOP_CHANNEL] = packet.crc_on << 6
        self._raise(RX_DONE)

    # --- State --------------------------------------------------------------------------------

    @property
    def _frequency_khz(self) -> int:
        frf = int.from_bytes(bytes(self.registers[FRF_MSB + i] for i in range(3)), "big")
        return round(frf * _CRYSTAL_HZ / 2**19 / 1000)

    @property
    def _bandwidth_khz(self) -> int:
        return _BANDWIDTHS_KHZ.get(self.registers[MODEM_CONFIG_1] >> 4, 125)

    @property
    def _channel(self) -> tuple[int, int, int]:
        return self._packet(b"").channel

    def _packet(self, payload: bytes) -> LoraPacket:
        one, two = self.registers[MODEM_CONFIG_1], self.registers[MODEM_CONFIG_2]
        return LoraPacket(
            self._frequency_khz,
            two >> 4,
            self._bandwidth_khz,
            (one >> 1 & 7) + 4,
            self.registers[SYNC_WORD],
            payload,
            self.strength_db,
            bool(two & 1 << 2),
        )

    def _rssi(self, strength_db: float) -> int:
        zero_dbm = -164 if self._frequency_khz < _LOW_BANDS_END_KHZ else -157
        return min(max(round(strength_db) - zero_dbm, 0), 255)

    def _raise(self, flags: int) -> None:
        self.registers[IRQ_FLAGS] = self.registers.get(IRQ_FLAGS, 0) | flags
        self._drive_irq()

    def _drive_irq(self) -> None:
        raised = self.registers.get(IRQ_FLAGS, 0) & ~self.registers.get(IRQ_FLAGS_MASK, 0)
        mapping = self.registers.get(DIO_MAPPING_1, 0) >> 6
        self._set_irq(bool(raised & _DIO0.get(mapping, 0)))
