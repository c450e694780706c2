"""Errors of an estimate against a reference: angles and metres, as arrays over time."""

import numpy as np

from gateway.analysis.flight import FlightTrack, FloatArray
from gateway.geometry.angle import wrap_180, wrap_pi
from gateway.geometry.geodesy import radii_m


def rms(values: FloatArray) -> float:
    """Return the root mean square of the known values; NaN if none is known."""
    return float(np.sqrt(np.mean(np.square(known)))) if len(known := _known(values)) else np.nan


def mean_abs(values: FloatArray) -> float:
    """Return the mean absolute value of the known values; NaN if none is known."""
    return float(np.mean(np.abs(known))) if len(known := _known(values)) else np.nan


def worst(values: FloatArray) -> float:
    """Return the greatest absolute value of the known values; NaN if none is known."""
    return greatest(np.abs(values))


def greatest(values: FloatArray) -> float:
    """Return the greatest of the known values; NaN if none is known."""
    return float(known.max()) if len(known := _known(values)) else np.nan


def _known(values: FloatArray) -> FloatArray:
    return values[np.isfinite(values)]


def rotation_error(q_nb: FloatArray, reference_q_nb: FloatArray) -> FloatArray:
    """Return the rotation in NED from the reference to the estimate: `q * conj(reference)`."""
    pw, px, py, pz = q_nb.T
    w, x, y, z = reference_q_nb.T
    error = np.column_stack(
        [
            pw * w + px * x + py * y + pz * z,
            px * w - pw * x - py * z + pz * y,
            py * w - pw * y + px * z - pz * x,
            pz * w - pw * z - px * y + py * x,
        ]
    )
    return np.where(error[:, :1] < 0.0, -error, error)


def total_error_rad(error: FloatArray) -> FloatArray:
    """Return the angle of a rotation error of shape (N, 4)."""
    return np.asarray(2.0 * np.arctan2(np.linalg.norm(error[:, 1:], axis=1), error[:, 0]))


def heading_error_rad(error: FloatArray) -> FloatArray:
    """Return the part of a rotation error about the vertical, clockwise from above positive."""
    return np.asarray(2.0 * np.arctan2(error[:, 3], error[:, 0]))


def inclination_error_rad(error: FloatArray) -> FloatArray:
    """Return the part of a rotation error about a horizontal axis; at least 0."""
    return np.asarray(
        2.0 * np.arctan2(np.hypot(error[:, 1], error[:, 2]), np.hypot(error[:, 0], error[:, 3]))
    )


def euler_rad(q_nb: FloatArray) -> FloatArray:
    """Convert attitudes to roll, pitch and yaw, shape (N, 3): eq. 16, corrected."""
    w, x, y, z = q_nb.T
    return np.column_stack(
        [
            np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
            np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0)),
            np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
        ]
    )


def position_error_m(track: FlightTrack, reference: FlightTrack) -> FloatArray:
    """Return the displacement from the reference to the estimate, shape (N, 3): north, east, up."""
    known = np.isfinite(reference.lat_deg)
    if not known.any():
        return np.full((len(track.lat_deg), 3), np.nan)
    first = int(np.argmax(known))
    meridian, parallel = radii_m(
        float(reference.lat_deg[first]), float(np.nan_to_num(reference.alt_amsl_m[first]))
    )
    east_deg = wrap_180(track.lon_deg - reference.lon_deg)
    return np.column_stack(
        [
            np.radians(track.lat_deg - reference.lat_deg) * meridian,
            np.radians(east_deg) * parallel,
            track.alt_amsl_m - reference.alt_amsl_m,
        ]
    )


def errors_over_time(track: FlightTrack, reference: FlightTrack) -> dict[str, FloatArray]:
    """Return every error at every sample, in the units of their names."""
    turned = rotation_error(track.q_nb, reference.q_nb)
    angles = np.degrees(wrap_pi(euler_rad(track.q_nb) - euler_rad(reference.q_nb)))
    error_m = position_error_m(track, reference)
    return {
        "roll_deg": angles[:, 0],
        "pitch_deg": angles[:, 1],
        "yaw_deg": angles[:, 2],
        "tilt_deg": np.degrees(inclination_error_rad(turned)),
        "heading_deg": np.degrees(heading_error_rad(turned)),
        "horizontal_m": np.hypot(error_m[:, 0], error_m[:, 1]),
        "height_m": error_m[:, 2],
        "speed_mps": np.linalg.norm(track.vel_n_mps - reference.vel_n_mps, axis=1),
    }
