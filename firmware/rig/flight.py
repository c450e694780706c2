"""A simulated flight as the world of the bench: the gateway's own simulator feeds the chips."""

import math
from typing import Final

import msgspec

from firmware.rig.world import Moment, Solution, Vec3, World
from gateway.simulator.flight import START_UNIX_US, SimulatedAircraft
from gateway.simulator.gps import GPS_RATE_HZ
from gateway.simulator.sensors import ACCEL_RANGE, GYRO_LSB_PER_DPS, GYRO_RANGE, MAG_GAIN
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.units import STANDARD_GRAVITY_MPS2, UT_PER_GAUSS
from gateway.wire.payloads import ACCEL_RANGES_G, MAG_LSB_PER_GAUSS

SAMPLE_HZ: Final = 1000
"""The rate at which the flight is sampled for the MPU6050, whatever the node then reads."""
PIECE_S: Final = 0.1

_MPS2_PER_COUNT: Final = ACCEL_RANGES_G[ACCEL_RANGE] * STANDARD_GRAVITY_MPS2 / 32768
_RADPS_PER_COUNT: Final = math.radians(1 / GYRO_LSB_PER_DPS[GYRO_RANGE])
_UT_PER_COUNT: Final = UT_PER_GAUSS / MAG_LSB_PER_GAUSS[MAG_GAIN]


class FlightWorld:
    """The sensors of one simulated aircraft as functions of the bench's time.

    Parameters
    ----------
    settings : SimulatorSettings
        Rates and radio are left aside: the firmware has its own.
    start_s : float
        Where in the flight the bench starts; a multiple of a fix's interval.
    start_unix_us : int
        UTC at the start of the flight.
    """

    def __init__(
        self,
        settings: SimulatorSettings,
        start_s: float = 0.0,
        start_unix_us: int = START_UNIX_US,
    ) -> None:
        fast = msgspec.structs.replace(settings, imu_rate_hz=SAMPLE_HZ, clock_skew_ppm=0.0)
        self.aircraft = SimulatedAircraft(fast, start_unix_us=start_unix_us)
        self.start_s = start_s
        self._start_unix_us, self._geoid_separation_m = start_unix_us, settings.geoid_separation_m
        self.world = World(self.moment, self.solution, start_unix_us + round(start_s * 1e6))
        self._taken_s = self._gps_taken_s = 0.0
        self._moments: list[Moment] = []
        self._first = 0
        """Index, in samples since the flight's start, of the oldest moment that is kept."""
        self._pressure_pa, self._solutions = 0.0, dict[int, Solution]()

    def moment(self, time_s: float) -> Moment:
        """Return the measured quantities at a time of the bench, which may only go back a bit."""
        flight_s = time_s + self.start_s
        while flight_s >= self._taken_s - 1.5 / SAMPLE_HZ:
            self._take(self._taken_s + PIECE_S)
        index = int(flight_s * SAMPLE_HZ) - self._first
        return self._moments[max(index, 0)]

    def solution(self, time_s: float) -> Solution:
        """Return the fix that was valid at a time of the bench."""
        flight_s = time_s + self.start_s
        while flight_s >= self._gps_taken_s - 0.5 / GPS_RATE_HZ:
            self._gps_taken_s += 1.0
            self._take_gps(self._gps_taken_s)
        return self._solutions[round(flight_s * GPS_RATE_HZ)]

    def _take(self, until_s: float) -> None:
        """Sample one more piece; the one before it is kept for sensors that look back."""
        self._taken_s = until_s
        kept = self._moments[-round(PIECE_S * SAMPLE_HZ) :]
        self._first += len(self._moments) - len(kept)
        imu = self.aircraft.imu.take(until_s)
        baro = self.aircraft.baro.take(until_s)
        if len(baro.pressure_pa):
            self._pressure_pa = float(baro.pressure_pa[-1])
        accel = (imu.accel_raw * _MPS2_PER_COUNT).tolist()
        gyro = (imu.gyro_raw * _RADPS_PER_COUNT).tolist()
        mag = (imu.mag_raw * _UT_PER_COUNT).tolist()
        temperature = (imu.temperature_raw / 340 + 36.53).tolist()
        rows = zip(accel, gyro, mag, temperature, strict=True)
        self._moments = kept + [
            Moment(_vec3(a), _vec3(g), _vec3(m), t, self._pressure_pa) for a, g, m, t in rows
        ]

    def _take_gps(self, until_s: float) -> None:
        gps = self.aircraft.gps.take(until_s)
        for k, unix_us in enumerate(gps.unix_us.tolist()):
            valid_s = (unix_us - self._start_unix_us) * 1e-6
            self._solutions[round(valid_s * GPS_RATE_HZ)] = Solution(
                lat_deg=float(gps.lat_deg[k]),
                lon_deg=float(gps.lon_deg[k]),
                alt_amsl_m=float(gps.alt_amsl_m[k]),
                geoid_separation_m=self._geoid_separation_m,
                vel_n_mps=_vec3(gps.vel_n_mps[k].tolist()),
                h_acc_m=float(gps.h_acc_m[k]),
                v_acc_m=float(gps.v_acc_m[k]),
                speed_acc_mps=float(gps.speed_acc_mps[k]),
                course_acc_deg=float(gps.course_acc_deg[k]),
                pdop=float(gps.pdop[k]),
                fix_type=int(gps.fix_type[k]),
                fix_ok=bool(gps.has_fix[k]),
                satellites=int(gps.satellites[k]),
                time_valid=bool(gps.time_valid[k]),
            )


def _vec3(values: list[float]) -> Vec3:
    x, y, z = values
    return x, y, z
