"""A simulated aircraft: its motion and the samplers of its sensors."""

from typing import Final

import msgspec

from gateway.simulator.gps import GpsSampler
from gateway.simulator.sensors import (
    BaroSampler,
    Chance,
    DeviceClock,
    ImuSampler,
    SensorErrors,
    errors_of,
    generator,
)
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.simulator.trajectory import SensorMotion, Trajectory

START_UNIX_US: Final = 1_781_402_400_000_000
"""14 June 2026, 02:00 UTC, where the caller names no other moment."""
IMU_NODE: Final = 0
GPS_NODE: Final = 1
GPS_BOOT_US: Final = 3_141_592
NEIGHBOUR_DEG: Final = 0.0006
"""Each further aircraft's home is this much further south."""


class SimulatedAircraft:
    """One aircraft with its sensors, for an unlimited time, from a UTC time on.

    The first one has the index 0; the next ones have the next ids, other gusts and another home. By
    default its motion is the planned flight.
    """

    def __init__(
        self,
        settings: SimulatorSettings,
        index: int = 0,
        start_unix_us: int = START_UNIX_US,
        motion: SensorMotion | None = None,
    ) -> None:
        home_lat_deg = settings.home_lat_deg - index * NEIGHBOUR_DEG
        settings = msgspec.structs.replace(settings, home_lat_deg=home_lat_deg)
        self.vehicle_id = settings.vehicle_id + index
        self.trajectory = Trajectory(settings, generator(settings, self.vehicle_id, Chance.GUSTS))
        motion = motion or self.trajectory
        self.imu = ImuSampler(settings, motion, self.vehicle_id)
        self.baro = BaroSampler(settings, motion, self.vehicle_id)
        gps_chance = generator(settings, self.vehicle_id, Chance.GPS)
        self.gps = GpsSampler(settings, motion, gps_chance, start_unix_us)
        self.gps_clock = DeviceClock(GPS_BOOT_US, -settings.clock_skew_ppm)

    @property
    def errors(self) -> SensorErrors:
        """The ideal calibration of this aircraft's sensors."""
        return errors_of(self.imu.inertial, self.imu.magnetometer)
