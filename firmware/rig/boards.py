"""The three boards: a chip, its program, and the modules soldered to it."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np

from firmware.rig.air import Air
from firmware.rig.barometer import make_barometer
from firmware.rig.bench import Bench
from firmware.rig.compass import make_compass
from firmware.rig.gps import COMPUTING_S, GPS_MODULES, Gps
from firmware.rig.i2c import I2cBus
from firmware.rig.imu import IMU_CHIPS, Imu
from firmware.rig.mcu import FIRMWARE, Mcu
from firmware.rig.nrf24 import RADIO_CHIPS, Nrf24
from firmware.rig.sx1276 import Sx1276
from firmware.rig.world import World

_CE: Final = 1 << 1
"""CE of an nRF24L01+, the reset line of an SX1276."""
_CSN: Final = 1 << 2
_IMU_LINE: Final = 2
_RADIO_LINE: Final = 3


@dataclass(frozen=True)
class Parts:
    """Which chips are soldered to the boards."""

    imu: str = "MPU6050"
    compass: str = "HMC5883L"
    barometer: str = "BMP180"
    gps: str = "u-blox M8"
    gps_baud: int | None = None
    """Stored speed; that of the module if None."""
    radio: str = "nRF24L01+"
    """The receiver's."""
    node_radio: str = "nRF24L01+"


LORA_VERSIONS: Final = {"SX1276": 0x12, "look-alike 0x11": 0x11, "look-alike 0x22": 0x22}
"""Version registers of LoRa chips, by name."""
LORA_PARTS: Final = {"radio": "SX1276", "node_radio": "SX1276"}
"""Of `Parts`, for programs that were built for this radio."""


@dataclass
class Setup:
    """Set-up that the boards share.

    Parameters
    ----------
    seed : int
        Of everything random; boards draw from streams of their own.
    build : Path
        Where the programs are.
    """

    seed: int = 1
    loss: float = 0.0
    noise: float = 0.0
    world: World = field(default_factory=World)
    build: Path = FIRMWARE / "build" / "nrf24_16mhz"
    frequency_hz: int = 16_000_000
    gps_computing_s: float = COMPUTING_S
    parts: Parts = field(default_factory=Parts)

    def __post_init__(self) -> None:
        self.bench = Bench()
        self._seeds = np.random.SeedSequence(self.seed)
        self.air = Air(self.bench, self.rng(), self.loss, self.noise)

    def rng(self) -> np.random.Generator:
        """Return the next independent stream."""
        return np.random.default_rng(self._seeds.spawn(1)[0])


class Board:
    """A chip with a radio.

    Parameters
    ----------
    setup : Setup
    program : str
        Name of the `.hex` file.
    clock_ppm : float
        Error of the board's crystal.
    """

    def __init__(self, setup: Setup, program: str, clock_ppm: float = 0.0) -> None:
        self.setup = setup
        self.mcu = Mcu(setup.build / f"{program}.hex", setup.frequency_hz, clock_ppm)
        setup.bench.chips.append(self.mcu)
        self.radio = self._make_radio(
            setup.parts.radio if program == "receiver" else setup.parts.node_radio
        )
        self.mcu.on_spi = self.radio.begin
        self.mcu.on_port_b = self._port_b
        Board._restore_lines(self)
        self.mcu.on_reset = self._restore_lines

    def _make_radio(self, chip: str) -> Nrf24 | Sx1276:
        """Solder a radio to the board; its first act is to drive its line."""
        edges = (
            self.setup.bench,
            self.setup.air,
            lambda: self.mcu.now_ps,
            self._drive_radio_line,
        )
        if chip in LORA_VERSIONS:
            return Sx1276(*edges, LORA_VERSIONS[chip])
        return Nrf24(*edges, RADIO_CHIPS[chip])

    def reset(self, cause: int, through_bootloader: bool = False) -> None:
        """Restart the chip; radio and sensors keep their state."""
        self.mcu.reset(cause, through_bootloader)

    def close(self) -> None:
        """Free the chip."""
        self.mcu.close()

    def _port_b(self, value: int) -> None:
        self.radio.enable(bool(value & _CE))
        if value & _CSN:
            self.radio.deselect(self.mcu.spi_data())

    def _drive_radio_line(self, high: bool) -> None:
        self._radio_line = high
        self.mcu.set_pin("D", _RADIO_LINE, high)

    def _restore_lines(self) -> None:
        self.mcu.set_pin("D", _RADIO_LINE, self._radio_line)


class ImuNode(Board):
    """ATmega328P, the sensors of a GY-87, radio."""

    def __init__(
        self, setup: Setup, clock_ppm: float = 0.0, program: str = "imu_node", noise: bool = True
    ) -> None:
        super().__init__(setup, program, clock_ppm)
        bench, world = setup.bench, setup.world
        chip = IMU_CHIPS[setup.parts.imu]
        self.imu = Imu(bench, world, setup.rng(), self._pulse_imu_line, chip, noise)
        parts, clock = setup.parts, self._clock
        self.compass = make_compass(parts.compass, world, clock, self.imu)
        self.barometer = make_barometer(parts.barometer, world, clock)
        self.bus = I2cBus(self.mcu, [self.imu, self.compass, self.barometer])

    def _clock(self) -> int:
        return self.mcu.now_ps

    def _pulse_imu_line(self, duration_us: int) -> None:
        self.mcu.pulse(_IMU_LINE, duration_us)

    def _restore_lines(self) -> None:
        super()._restore_lines()
        self.bus.restore_lines()


class GpsNode(Board):
    """ATmega328P, GPS receiver, radio."""

    def __init__(self, setup: Setup, clock_ppm: float = 0.0, program: str = "gps_node") -> None:
        super().__init__(setup, program, clock_ppm)
        module = GPS_MODULES[setup.parts.gps]
        if setup.parts.gps_baud is not None:
            module = replace(module, baud=setup.parts.gps_baud)
        self.gps = Gps(
            setup.bench,
            setup.world,
            setup.rng(),
            self.mcu.uart_feed,
            lambda: self.mcu.uart_baud,
            module,
            setup.gps_computing_s,
        )
        self.mcu.watch_line()
        setup.bench.after_step.append(self._pass_bytes)

    def _pass_bytes(self) -> None:
        for end_ps, byte in self.mcu.uart_take():
            self.gps.hear(end_ps, byte)
        self.gps.sample()


class Receiver(Board):
    """ATmega328P, radio, serial line to the gateway."""

    def __init__(self, setup: Setup, clock_ppm: float = 0.0, program: str = "receiver") -> None:
        super().__init__(setup, program, clock_ppm)
        self._sent: list[tuple[int, int]] = []
        setup.bench.after_step.append(self._take)

    def take_bytes(self) -> list[tuple[int, int]]:
        """Return the bytes sent since the last call: the end of each byte in ps, and the byte."""
        sent, self._sent = self._sent, []
        return sent

    def _take(self) -> None:
        self._sent += self.mcu.uart_take()
