"""Other people's estimators, run on the same samples: each gives `q_nb` per IMU sample."""

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from tools.flights import Flight

FLU_FROM_FRD = Rotation.from_quat([0.0, 1.0, 0.0, 0.0], scalar_first=True)
NED_FROM_ENU = Rotation.from_quat([0.0, 0.5**0.5, 0.5**0.5, 0.0], scalar_first=True)


def _in_ned(q_enu_flu: np.ndarray, flight: Flight) -> np.ndarray:
    """Turn an ENU/FLU attitude against magnetic north into NED/FRD against true north."""
    declination = Rotation.from_euler("z", flight.reference.declination_deg, degrees=True)
    turned = declination * NED_FROM_ENU * Rotation.from_quat(q_enu_flu, scalar_first=True)
    return (turned * FLU_FROM_FRD).as_quat(scalar_first=True)


def _flu(flight: Flight) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    imu = flight.log.imu[:, :9] * np.tile([1.0, -1.0, -1.0], 3)
    dt_s = float(np.mean(np.diff(flight.log.imu_time_us))) * 1e-6
    return imu[:, 3:6].copy(), imu[:, 0:3].copy(), imu[:, 6:9].copy(), dt_s


def _held(mag: np.ndarray) -> np.ndarray:
    """Hold the last magnetometer value."""
    index = np.where(np.isfinite(mag[:, 0]), np.arange(len(mag)), 0)
    index = np.maximum.accumulate(index)
    return np.where(np.isfinite(mag[index]), mag[index], 0.0)


def run_vqf(flight: Flight) -> np.ndarray:
    """VQF of Laidig and Seel, its defaults."""
    from vqf import VQF

    gyro, accel, mag, dt_s = _flu(flight)
    new = np.isfinite(mag[:, 0])
    vqf = VQF(dt_s, magTs=dt_s / max(float(new.mean()), 1e-9)) if new.any() else VQF(dt_s)
    out = np.empty((len(gyro), 4))
    for i in range(len(gyro)):
        vqf.updateGyr(gyro[i])
        vqf.updateAcc(accel[i])
        if new[i]:
            vqf.updateMag(mag[i])
        out[i] = vqf.getQuat9D() if new.any() else vqf.getQuat6D()
    return _in_ned(out, flight)


def run_imufusion(flight: Flight) -> np.ndarray:
    """x-io Fusion's AHRS, its documented settings for 9 axes."""
    import imufusion

    gyro, accel, mag, dt_s = _flu(flight)
    use_mag = bool(np.isfinite(mag).any())
    mag, ahrs = _held(mag), imufusion.Ahrs()
    rate_hz = max(1, round(1.0 / dt_s))
    ahrs.settings = imufusion.Settings(imufusion.CONVENTION_ENU, 0.5, 2000, 10, 10, 5 * rate_hz)
    out = np.empty((len(gyro), 4))
    gyro, accel = np.degrees(gyro), accel / 9.80665
    for i in range(len(gyro)):
        if use_mag:
            ahrs.update(gyro[i], accel[i], mag[i], dt_s)
        else:
            ahrs.update_no_magnetometer(gyro[i], accel[i], dt_s)
        out[i] = ahrs.quaternion.wxyz
    return _in_ned(out, flight)


def run_madgwick(flight: Flight) -> np.ndarray:
    """Madgwick's filter of the `ahrs` package, its defaults."""
    from ahrs.common.orientation import am2q
    from ahrs.filters import Madgwick

    gyro, accel, mag, dt_s = _flu(flight)
    use_mag = bool(np.isfinite(mag).any())
    mag = _held(mag)
    madgwick = Madgwick(Dt=dt_s)
    q = am2q(accel[0], mag[0], frame="ENU") if use_mag else np.array([1.0, 0.0, 0.0, 0.0])
    q = np.ravel(q)
    out = np.empty((len(gyro), 4))
    for i in range(len(gyro)):
        if use_mag:
            q = madgwick.updateMARG(q, gyr=gyro[i], acc=accel[i], mag=mag[i])
        else:
            q = madgwick.updateIMU(q, gyr=gyro[i], acc=accel[i])
        out[i] = q
    return _in_ned(out, flight)


PEERS: dict[str, Callable[[Flight], np.ndarray]] = {
    "vqf": run_vqf,
    "imufusion": run_imufusion,
    "ahrs madgwick": run_madgwick,
}
