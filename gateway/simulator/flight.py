"""A simulated aircraft: its motion and the samplers of its sensors."""

from typing import Any, Final

import msgspec

from gateway.simulator.gps import GpsSampler
from gateway.simulator.sensors import (
    BaroSampler,
    Chance,
    DeviceClock,
    ImuSampler,
    errors_of,
    generator,
)
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.simulator.trajectory import SensorMotion, Trajectory

START_UNIX_US: Final = 1_781_402_400_000_000
"""Default time at the start: 14 June 2026, 02:00 UTC."""
IMU_NODE: Final = 0
GPS_NODE: Final = 1
GPS_BOOT_US: Final = 3_141_592
NEIGHBOUR_DEG: Final = 0.0006
"""Distance between the homes of consecutive aircraft, southwards."""


class SimulatedAircraft:
    """One aircraft with its sensors, for an unlimited time, starting at a UTC time.

    The first aircraft has the index 0; others have the next ids, other gusts and other homes. By
    default the motion is the planned flight.
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
    def errors(self) -> dict[str, Any]:
        """Constant errors of this aircraft's sensors; see `errors_of`."""
        return errors_of(self.imu.inertial, self.imu.magnetometer)
