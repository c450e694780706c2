"""nRF24L01+ at its registers: Enhanced ShockBurst with dynamic lengths.

Times and rules are those of the product specification 1.0; comments cite its sections.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from firmware.rig.air import Air, Packet, Transmission
from firmware.rig.bench import PS_PER_US, Bench

SETTLING_PS: Final = 130 * PS_PER_US
"""From standby to sending or receiving: table 16."""
CONFIG, EN_AA, EN_RXADDR, SETUP_AW, SETUP_RETR, RF_CH, RF_SETUP, STATUS = range(8)
OBSERVE_TX, RPD, RX_ADDR_P0 = 8, 9, 0x0A
TX_ADDR, FIFO_STATUS, DYNPD, FEATURE = 0x10, 0x17, 0x1C, 0x1D
RX_DR, TX_DS, MAX_RT = 1 << 6, 1 << 5, 1 << 4
_CAUSES: Final = RX_DR | TX_DS | MAX_RT
_EN_DPL: Final = 1 << 2
_FIFO_DEPTH: Final = 3
_RESET_VALUES: Final = {
    CONFIG: 0x08, EN_AA: 0x3F, EN_RXADDR: 0x03, SETUP_AW: 0x03, SETUP_RETR: 0x03, RF_CH: 0x02,
    RF_SETUP: 0x0E, OBSERVE_TX: 0, DYNPD: 0, FEATURE: 0,
}  # fmt: skip
_PIPES: Final = 6
_EN_DYN_ACK: Final = 1 << 0
_ACTIVATE, _ACTIVATE_KEY = 0x50, 0x73


@dataclass(frozen=True, slots=True)
class RadioChip:
    """How a chip differs from the nRF24L01+."""

    hides_features: bool = False
    """FEATURE and DYNPD are out of reach until ACTIVATE; a second one hides them again."""
    reverses_no_ack: bool = False
    """In the packet; a receiver minds the bit only with EN_DYN_ACK."""
    lost_registers: tuple[int, ...] = ()
    """A broken module: these registers keep their reset value."""


RADIO_CHIPS: Final = {
    "nRF24L01+": RadioChip(),
    "nRF24L01": RadioChip(hides_features=True),
    "Si24R1": RadioChip(reverses_no_ack=True),
    "clone with ACTIVATE": RadioChip(hides_features=True, reverses_no_ack=True),
    "loses FEATURE": RadioChip(lost_registers=(FEATURE,)),
    "loses DYNPD": RadioChip(lost_registers=(DYNPD,)),
    "loses the rate": RadioChip(lost_registers=(RF_SETUP,)),
    "loses its address": RadioChip(lost_registers=(RX_ADDR_P0,)),
}


class Nrf24:
    """One chip.

    Parameters
    ----------
    bench : Bench
    air : Air
    board_now_ps : callable
        The present of the board that talks to the chip: within a step it is ahead of the bench's.
    set_irq : callable
        Drives the interrupt line; True is high, at rest.
    """

    def __init__(
        self,
        bench: Bench,
        air: Air,
        board_now_ps: Callable[[], int],
        set_irq: Callable[[bool], None],
        chip: RadioChip,
    ) -> None:
        self._bench, self._air, self._chip = bench, air, chip
        self._board_now_ps, self._set_irq = board_now_ps, set_irq
        self.absent = False
        air.listeners.append(self)
        self.power_cycle()

    def power_cycle(self) -> None:
        """Lose everything, as when the supply dips."""
        self.registers = dict(_RESET_VALUES)
        self.addresses = {RX_ADDR_P0 + pipe: b"\xe7" * 5 for pipe in range(_PIPES)}
        self.addresses[TX_ADDR] = b"\xe7" * 5
        self._features_hidden = self._chip.hides_features
        self._causes = 0
        self._tx: deque[tuple[bytes, int]] = deque()
        self._rx: deque[tuple[int, bytes]] = deque()
        self._identity = 0
        self._heard: dict[int, tuple[int, bytes]] = {}
        self._ce = False
        self._command: int | None = None
        self._listening_ps: int | None = None
        self._attempt = 0
        self._job = 0
        self._carrier_latched = False
        self._drive_irq()

    # --- The pins -----------------------------------------------------------------------------

    def deselect(self, data: bytes) -> None:
        """Raise CSN behind a command and its data."""
        if self._command is not None:
            command, self._command = self._command, None
            self._finish(command, data)

    def enable(self, ce: bool) -> None:
        """Move CE."""
        if ce == self._ce or self.absent:
            return
        self._ce = ce
        if ce and self._receiving_mode():
            self._listening_ps = self._board_now_ps() + SETTLING_PS
            self._carrier_latched = False
        elif not ce:
            self._listening_ps = None
        if ce and self._tx and not self._receiving_mode() and not self._causes & MAX_RT:
            self._begin_job()

    def begin(self, command: int) -> tuple[int, bytes]:
        """Handle a command; return the answers to it and to the bytes behind it."""
        if self.absent:
            return 0xFF, b"\xff" * 32
        self._command = command
        answer = self._answer(command)
        return self._status(), answer

    # --- Commands: table 20 -------------------------------------------------------------------

    def _answer(self, command: int) -> bytes:
        if command < 0x20:
            return self.addresses.get(command) or bytes([self._read_register(command)])
        if command == 0x60:
            return bytes([len(self._rx[0][1]) if self._rx else 0])
        if command == 0x61 and self._rx:
            return self._rx.popleft()[1]
        return b""

    def _finish(self, command: int, data: bytes) -> None:
        if 0x20 <= command < 0x40 and data:
            self._write_register(command & 0x1F, data)
        elif command == 0xA0 and len(self._tx) < _FIFO_DEPTH:
            self._identity = (self._identity + 1) % 4
            self._tx.append((data, self._identity))
            if self._ce and not self._receiving_mode() and len(self._tx) == 1:
                self._begin_job()
        elif command == _ACTIVATE and data == bytes([_ACTIVATE_KEY]):
            self._features_hidden = self._chip.hides_features and not self._features_hidden
        elif command == 0xE1:
            self._tx.clear()
            self._job += 1
        elif command == 0xE2:
            self._rx.clear()

    def _read_register(self, register: int) -> int:
        if register == STATUS:
            return self._status()
        if register == FIFO_STATUS:
            full, empty = len(self._rx) == _FIFO_DEPTH, not self._rx
            tx_full, tx_empty = len(self._tx) == _FIFO_DEPTH, not self._tx
            return tx_full << 5 | tx_empty << 4 | full << 1 | empty
        if register == RPD:
            return int(self._carrier())
        return self.registers.get(register, 0)

    def _write_register(self, register: int, data: bytes) -> None:
        if register in self._chip.lost_registers:
            return
        if register in (FEATURE, DYNPD) and self._features_hidden:
            return
        if register in self.addresses:
            whole = self.addresses[register]
            self.addresses[register] = data[:5] + whole[len(data) :]
            if register == RX_ADDR_P0 + 1:
                for pipe in range(2, _PIPES):
                    lowest = self.addresses[RX_ADDR_P0 + pipe][:1]
                    self.addresses[RX_ADDR_P0 + pipe] = lowest + data[1:5]
        elif register == STATUS:
            self._causes &= ~data[0]
            self._drive_irq()
        elif register not in (OBSERVE_TX, RPD, FIFO_STATUS):
            self.registers[register] = data[0]

    def _status(self) -> int:
        pipe = self._rx[0][0] if self._rx else 7
        return self._causes | pipe << 1 | (len(self._tx) == _FIFO_DEPTH)

    def _carrier(self) -> bool:
        if self._listening_ps is None:
            return False
        return self._carrier_latched or self._air.carrier(self._channel, self._board_now_ps())

    # --- Sending: section 7.4.1, figure 5 -----------------------------------------------------

    def _begin_job(self) -> None:
        self._job += 1
        self._attempt = 0
        self._begin_attempt(self._job, self._board_now_ps() + SETTLING_PS)

    def _begin_attempt(self, job: int, at_ps: int) -> None:
        def send() -> None:
            if job == self._job and self._tx and self._powered:
                payload, identity = self._tx[0]
                address, no_ack = self.addresses[TX_ADDR], self._chip.reverses_no_ack
                packet = Packet(
                    self._channel, self._kbps, address, payload, identity, False, no_ack
                )
                self._listening_ps = None
                self._air.send(packet, self, lambda: self._sent(job))

        self._bench.at(at_ps, send)

    def _sent(self, job: int) -> None:
        if job != self._job:
            return
        if not self.registers[EN_AA] & 1:
            self._end_job(TX_DS)
            return
        self._listening_ps = self._bench.now_ps + SETTLING_PS
        pause_us = 250 * (1 + (self.registers[SETUP_RETR] >> 4))
        self._bench.at(self._bench.now_ps + pause_us * PS_PER_US, lambda: self._unanswered(job))

    def _unanswered(self, job: int) -> None:
        if job != self._job:
            return
        if self._attempt >= self.registers[SETUP_RETR] & 0x0F:
            self._listening_ps = None
            self._causes |= MAX_RT
            self._drive_irq()
            return
        self._attempt += 1
        self.registers[OBSERVE_TX] = self._attempt
        self._begin_attempt(job, self._bench.now_ps)

    def _end_job(self, cause: int) -> None:
        self._job += 1
        self.registers[OBSERVE_TX] = self._attempt
        self._listening_ps = None
        if self._tx:
            self._tx.popleft()
        self._causes |= cause
        self._drive_irq()
        if self._ce and self._tx:
            self._begin_job()

    # --- Receiving: section 7.4.2 -------------------------------------------------------------

    def listens(self, packet: Transmission, start_ps: int) -> bool:
        """Whether it has been receiving such packets since `start_ps`."""
        since = self._listening_ps
        return (
            since is not None
            and since <= start_ps
            and isinstance(packet, Packet)
            and (packet.channel, packet.kbps) == (self._channel, self._kbps)
        )

    def hear(self, packet: Transmission) -> None:
        """Take an undamaged packet."""
        assert isinstance(packet, Packet)
        if self._receiving_mode():
            self._hear_data(packet)
        elif packet.is_ack and packet.address == self.addresses[RX_ADDR_P0]:
            self._end_job(TX_DS)

    def _hear_data(self, packet: Packet) -> None:
        pipe = self._pipe_of(packet.address)
        if packet.is_ack or pipe is None or not self._takes_dynamic_lengths(pipe):
            return
        self._carrier_latched = True
        content = (packet.identity, packet.payload)
        duplicate = self._heard.get(pipe) == content
        if not duplicate:
            if len(self._rx) == _FIFO_DEPTH:
                return
            self._heard[pipe] = content
            self._rx.append((pipe, packet.payload))
            self._causes |= RX_DR
            self._drive_irq()
        minds_no_ack = self.registers[FEATURE] & _EN_DYN_ACK
        no_ack = packet.no_ack != self._chip.reverses_no_ack
        if self.registers[EN_AA] >> pipe & 1 and not (minds_no_ack and no_ack):
            self._acknowledge(packet)

    def _acknowledge(self, packet: Packet) -> None:
        ack = Packet(packet.channel, packet.kbps, packet.address, b"", packet.identity, True)
        now_ps = self._bench.now_ps
        self._listening_ps = now_ps + 2 * SETTLING_PS + ack.duration_ps
        self._bench.at(now_ps + SETTLING_PS, lambda: self._air.send(ack, self, lambda: None))

    def _pipe_of(self, address: bytes) -> int | None:
        for pipe in range(_PIPES):
            enabled = self.registers[EN_RXADDR] >> pipe & 1
            if enabled and self.addresses[RX_ADDR_P0 + pipe] == address:
                return pipe
        return None

    def _takes_dynamic_lengths(self, pipe: int) -> bool:
        return bool(self.registers[FEATURE] & _EN_DPL and self.registers[DYNPD] >> pipe & 1)

    # --- State --------------------------------------------------------------------------------

    @property
    def _channel(self) -> int:
        return self.registers[RF_CH]

    @property
    def _kbps(self) -> int:
        low, high = self.registers[RF_SETUP] >> 5 & 1, self.registers[RF_SETUP] >> 3 & 1
        return 250 if low else 2000 if high else 1000

    @property
    def _powered(self) -> bool:
        return bool(self.registers[CONFIG] & 0x02)

    def _receiving_mode(self) -> bool:
        return self.registers[CONFIG] & 0x03 == 0x03

    def _drive_irq(self) -> None:
        masked = self.registers[CONFIG] & _CAUSES
        self._set_irq(not self._causes & ~masked)
