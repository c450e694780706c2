"""Other estimators on the same samples: VQF, and a textbook error-state Kalman filter."""

import math
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from gateway.estimation.columns import (
    GPS_ALT,
    GPS_DECLINATION,
    GPS_LAT,
    GPS_LON,
    GPS_USABLE,
    GPS_VEL,
    NAV_COLUMNS,
    NAV_LAT,
    NAV_LON,
)
from gateway.geometry.geodesy import displacement_m, offset_deg
from gateway.units import STANDARD_GRAVITY_MPS2
from tools.flights import Flight

FLU_FROM_FRD = Rotation.from_quat([0.0, 1.0, 0.0, 0.0], scalar_first=True)
NED_FROM_ENU = Rotation.from_quat([0.0, 0.5**0.5, 0.5**0.5, 0.0], scalar_first=True)


def declination_rad(flight: Flight) -> float:
    """Return the declination of a flight."""
    known = flight.log.gps[:, GPS_DECLINATION]
    known = known[np.isfinite(known)]
    return float(known[0]) if len(known) else math.radians(flight.reference.declination_deg)


def run_vqf(flight: Flight) -> np.ndarray:
    """Run VQF of Laidig and Seel with its defaults; attitude only, shape (n, 4)."""
    from vqf import VQF

    time_s = flight.log.imu_time_us * 1e-6
    dt_s = float(np.median(np.diff(time_s)))
    grid_s = np.arange(time_s[0], time_s[-1] + dt_s, dt_s)
    imu = flight.log.imu[:, :9]
    sign = np.array([1.0, -1.0, -1.0])
    accel, gyro = (
        np.column_stack([np.interp(grid_s, time_s, imu[:, k + j]) for j in range(3)]) * sign
        for k in (0, 3)
    )
    rows = np.flatnonzero(np.isfinite(imu[:, 6]))
    mag = np.full((len(grid_s), 3), np.nan)
    mag[np.searchsorted(grid_s, time_s[rows]).clip(max=len(grid_s) - 1)] = imu[rows, 6:9] * sign
    new = np.isfinite(mag[:, 0])
    vqf = VQF(dt_s, magTs=dt_s / float(new.mean())) if len(rows) else VQF(dt_s)
    out = np.empty((len(grid_s), 4))
    for i in range(len(grid_s)):
        vqf.updateGyr(np.ascontiguousarray(gyro[i]))
        vqf.updateAcc(np.ascontiguousarray(accel[i]))
        if new[i]:
            vqf.updateMag(np.ascontiguousarray(mag[i]))
        out[i] = vqf.getQuat9D() if len(rows) else vqf.getQuat6D()
    q_ned = NED_FROM_ENU * Rotation.from_quat(out, scalar_first=True) * FLU_FROM_FRD
    turned = Rotation.from_euler("z", declination_rad(flight)) * q_ned
    back = np.searchsorted(grid_s, time_s).clip(max=len(grid_s) - 1)
    return turned.as_quat(scalar_first=True)[back]


class Textbook:
    """A plain filter of fifteen states with the attitude error in NED, after Sola (2017).

    Noises are those of the filter's defaults. Late fixes are extrapolated by their velocity;
    without GPS the specific force counts as gravity at every sample, with a large noise.
    """

    def __init__(self, flight: Flight) -> None:
        self.q, self.v, self.p = Rotation.identity(), np.zeros(3), np.zeros(3)
        self.bg, self.ba = np.zeros(3), np.zeros(3)
        self.P = np.diag([0.1] * 2 + [3.0] + [25.0] * 6 + [1e-4] * 3 + [0.01] * 3)
        self.latency_s, self.declination = flight.reference.gps_latency_s, declination_rad(flight)
        self.origin: tuple[float, float] | None = None

    def predict(self, gyro: np.ndarray, accel: np.ndarray, dt: float) -> None:
        """Advance by one sample."""
        self.q = self.q * Rotation.from_rotvec((gyro - self.bg) * dt)
        R = self.q.as_matrix()
        f = R @ (accel - self.ba)
        a = f + np.array([0.0, 0.0, STANDARD_GRAVITY_MPS2])
        self.p, self.v = self.p + self.v * dt + 0.5 * a * dt * dt, self.v + a * dt
        F = np.eye(15)
        F[0:3, 9:12] = F[3:6, 12:15] = -R * dt
        F[3:6, 0:3] = -_cross(f) * dt
        F[6:9, 3:6] = np.eye(3) * dt
        self.P = F @ self.P @ F.T
        noise = [1.3e-6] * 3 + [0.01] * 3 + [0.0] * 3 + [6e-9] * 3 + [3e-6] * 3
        self.P[np.diag_indices(15)] += np.array(noise) * dt

    def update(self, H: np.ndarray, innovation: np.ndarray, variance: np.ndarray) -> None:
        """Update by a measurement, and inject the error."""
        K = self.P @ H.T @ np.linalg.inv(H @ self.P @ H.T + np.diag(variance))
        d = K @ innovation
        self.P = (np.eye(15) - K @ H) @ self.P
        self.q = Rotation.from_rotvec(d[:3]) * self.q
        self.v, self.p = self.v + d[3:6], self.p + d[6:9]
        self.bg, self.ba = self.bg + d[9:12], self.ba + d[12:15]

    def take_fix(self, row: np.ndarray) -> None:
        """Update by position and velocity."""
        if row[GPS_USABLE] != 1.0:
            return
        if self.origin is None:
            self.origin = (float(row[GPS_LAT]), float(row[GPS_LON]))
            self.p = np.array([0.0, 0.0, -row[GPS_ALT]])
            self.v = np.nan_to_num(row[GPS_VEL : GPS_VEL + 3])
        north, east = displacement_m(*self.origin, row[GPS_LAT], row[GPS_LON], 0.0)
        vel = row[GPS_VEL : GPS_VEL + 3]
        pos = np.array([north, east, -row[GPS_ALT]]) + np.nan_to_num(vel) * self.latency_s
        H = np.zeros((6, 15))
        H[:3, 6:9] = H[3:, 3:6] = np.eye(3)
        off = np.concatenate([pos - self.p, vel - self.v])
        known = np.isfinite(off)
        self.update(H[known], off[known], np.array([1.4, 1.4, 4.0, 0.16, 0.16, 0.1])[known])

    def take_mag(self, mag: np.ndarray) -> None:
        """Update by the heading of the magnetic field."""
        field = self.q.apply(mag)
        heading = math.remainder(self.declination - math.atan2(field[1], field[0]), 2.0 * math.pi)
        H = np.zeros((1, 15))
        H[0, 2] = 1.0
        self.update(H, np.array([heading]), np.array([0.3]))

    def take_gravity(self, accel: np.ndarray) -> None:
        """Update by gravity without GPS, and keep the velocity."""
        f = self.q.apply(accel - self.ba)
        H = np.zeros((2, 15))
        H[0, 1], H[1, 0] = f[2], -f[2]
        self.update(H, -f[:2], np.array([100.0, 100.0]))
        self.v[:], self.p[:2] = 0.0, 0.0


def run_textbook(flight: Flight) -> np.ndarray:
    """Run the textbook filter; attitude and position, shape (n, NAV_COLUMNS)."""
    log, book = flight.log, Textbook(flight)
    out = np.full((len(log.imu_time_us), NAV_COLUMNS), np.nan)
    first = next(i for i in range(len(out)) if np.isfinite(log.imu[i, :6]).all())
    ax, ay, az = log.imu[first, :3]
    level = [0.0, math.atan2(ax, math.hypot(ay, az)), math.atan2(-ay, -az)]
    book.q = Rotation.from_euler("ZYX", level)
    last_us, fixes = int(log.imu_time_us[first]), 0
    aligned = False
    for i in range(first, len(out)):
        row, now_us = log.imu[i], int(log.imu_time_us[i])
        dt, last_us = min((now_us - last_us) * 1e-6, 0.5), now_us
        if np.isfinite(row[:6]).all() and dt > 0.0:
            book.predict(row[3:6], row[:3], dt)
            if book.origin is None and i % 5 == 0:
                book.take_gravity(row[:3])
        if np.isfinite(row[6]):
            if not aligned:
                field = book.q.apply(row[6:9])
                turn = book.declination - math.atan2(field[1], field[0])
                book.q, aligned = Rotation.from_euler("z", turn) * book.q, True
            book.take_mag(row[6:9])
        while fixes < len(log.gps) and log.gps_time_us[fixes] <= now_us:
            book.take_fix(log.gps[fixes])
            fixes += 1
        out[i, :4] = book.q.as_quat(scalar_first=True)
        if book.origin is not None:
            lat, lon = offset_deg(*book.origin, 0.0, book.p[0], book.p[1])
            out[i, NAV_LAT], out[i, NAV_LON] = lat, lon
    return out


def _cross(v: np.ndarray) -> np.ndarray:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


PEERS: dict[str, Callable[[Flight], np.ndarray]] = {"vqf": run_vqf, "textbook": run_textbook}
