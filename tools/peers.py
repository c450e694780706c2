"""Other people's estimators, run on the same samples: each gives `q_nb` per IMU sample."""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from tools.flights import Flight

FLU_FROM_FRD = Rotation.from_quat([0.0, 1.0, 0.0, 0.0], scalar_first=True)
NED_FROM_ENU = Rotation.from_quat([0.0, 0.5**0.5, 0.5**0.5, 0.0], scalar_first=True)


def _declination_deg(flight: Flight) -> float:
    known = flight.log.gps[:, 10]
    known = known[np.isfinite(known)]
    return float(np.degrees(known[0])) if len(known) else flight.reference.declination_deg


def _to_true_north(q_ned: Rotation, flight: Flight) -> np.ndarray:
    turn = Rotation.from_euler("z", _declination_deg(flight), degrees=True)
    return (turn * q_ned).as_quat(scalar_first=True)


def _uniform(flight: Flight) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """Resample to a constant rate, which these filters take for granted.

    Returns the samples, whether the magnetometer is new, the interval, and which resampled row
    stands for each of the log's.
    """
    time_s = flight.log.imu_time_us * 1e-6
    dt_s = float(np.median(np.diff(time_s)))
    grid_s = np.arange(time_s[0], time_s[-1] + dt_s, dt_s)
    imu = flight.log.imu[:, :9]
    out = np.column_stack([np.interp(grid_s, time_s, imu[:, k]) for k in range(6)])
    new = np.zeros(len(grid_s), bool)
    mag = np.full((len(grid_s), 3), np.nan)
    rows = np.flatnonzero(np.isfinite(imu[:, 6]))
    places = np.searchsorted(grid_s, time_s[rows]).clip(max=len(grid_s) - 1)
    mag[places], new[places] = imu[rows, 6:9], True
    back = np.searchsorted(grid_s, time_s).clip(max=len(grid_s) - 1)
    return np.column_stack([out, mag]), new, dt_s, back


def _held(mag: np.ndarray) -> np.ndarray:
    """Hold the last magnetometer value; before the first, the first."""
    known = np.flatnonzero(np.isfinite(mag[:, 0]))
    index = known[np.searchsorted(known, np.arange(len(mag)), side="right").clip(min=1) - 1]
    return mag[index]


def vqf_input(
    flight: Flight,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]:
    """Return specific force, rate, the held compass, where it is new, and the interval in s."""
    imu, new, dt_s, _ = _uniform(flight)
    mag = _held(imu[:, 6:9]) if new.any() else imu[:, 6:9]
    imu = np.column_stack([imu[:, :6], mag]) * np.tile([1.0, -1.0, -1.0], 3)
    accel, gyro, mag = (np.ascontiguousarray(imu[:, k : k + 3]) for k in (0, 3, 6))
    return accel, gyro, mag, new, dt_s


def run_vqf(flight: Flight) -> np.ndarray:
    """VQF of Laidig and Seel, its defaults."""
    from vqf import VQF

    accel, gyro, mag, new, dt_s = vqf_input(flight)
    *_, back = _uniform(flight)
    use_mag = bool(new.any())
    vqf = VQF(dt_s, magTs=dt_s / float(new.mean())) if use_mag else VQF(dt_s)
    out = np.empty((len(gyro), 4))
    for i in range(len(gyro)):
        vqf.updateGyr(gyro[i])
        vqf.updateAcc(accel[i])
        if new[i]:
            vqf.updateMag(mag[i])
        out[i] = vqf.getQuat9D() if use_mag else vqf.getQuat6D()
    enu = NED_FROM_ENU * Rotation.from_quat(out, scalar_first=True) * FLU_FROM_FRD
    return _to_true_north(enu, flight)[back]


def run_imufusion(flight: Flight) -> np.ndarray:
    """x-io Fusion's AHRS, its defaults but for NED axes."""
    import imufusion

    imu, new, dt_s, back = _uniform(flight)
    ahrs = imufusion.Ahrs()
    settings = imufusion.AhrsSettings()
    settings.convention = imufusion.CONVENTION_NED
    settings.sample_rate = 1.0 / dt_s
    ahrs.set_settings(settings)
    use_mag = bool(new.any())
    mag = _held(imu[:, 6:9]) if use_mag else imu[:, 6:9]
    # Its accelerometer reads plus one at rest along the axis that points up.
    accel, gyro = imu[:, 0:3] / 9.80665, np.degrees(imu[:, 3:6])
    out = np.empty((len(imu), 4))
    for i in range(len(imu)):
        if use_mag:
            ahrs.update(gyro[i], accel[i], mag[i])
        else:
            ahrs.update_no_magnetometer(gyro[i], accel[i])
        out[i] = ahrs.get_quaternion()
    return _to_true_north(Rotation.from_quat(out, scalar_first=True), flight)[back]


def run_madgwick(flight: Flight) -> np.ndarray:
    """Madgwick's filter of the `ahrs` package, its defaults; its north is the field's x axis."""
    from ahrs.filters import Madgwick

    imu, new, dt_s, back = _uniform(flight)
    imu = imu * np.tile([1.0, -1.0, -1.0], 3)
    use_mag = bool(new.any())
    mag = _held(imu[:, 6:9]) if use_mag else imu[:, 6:9]
    madgwick = Madgwick(Dt=dt_s)
    q = np.array([1.0, 0.0, 0.0, 0.0])
    out = np.empty((len(imu), 4))
    for i in range(len(imu)):
        if use_mag:
            q = madgwick.updateMARG(q, gyr=imu[i, 3:6], acc=imu[i, 0:3], mag=mag[i])
        else:
            q = madgwick.updateIMU(q, gyr=imu[i, 3:6], acc=imu[i, 0:3])
        out[i] = q
    nwu = FLU_FROM_FRD * Rotation.from_quat(out, scalar_first=True) * FLU_FROM_FRD
    return _to_true_north(nwu, flight)[back]


PEERS: dict[str, Callable[[Flight], np.ndarray]] = {
    "vqf": run_vqf,
    "imufusion": run_imufusion,
    "ahrs Madgwick": run_madgwick,
}
