"""Logs with a reference for scoring: samples for the estimators, and the truth."""

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from gateway.estimation.columns import (
    GPS_ALT,
    GPS_COLUMNS,
    GPS_DECLINATION,
    GPS_DIP,
    GPS_LAT,
    IMU_COLUMNS,
    MEANS,
    gps_row,
    imu_row,
    nav_row,
)
from gateway.estimation.kernel import SampleLog
from gateway.estimation.paper import PaperEstimator, PaperSettings
from gateway.estimation.reference import EarthField, ReferenceSettings
from gateway.geometry.geodesy import radii_m
from gateway.records import BaroRaw, GpsFix, GpsFixType, ImuFlags, ImuRaw, ImuSample, NodeId
from gateway.sensing.calibration import NodeCalibration
from gateway.sensing.chain import SensorChain
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.units import DEGE7_PER_DEG
from tools.simulated_flight import fly

IMU_NAMES = ["ax", "ay", "az", "gx", "gy", "gz", "mx", "my", "mz"]
QUAT_NAMES = ["ref_qw", "ref_qx", "ref_qy", "ref_qz"]
OFFSET_S = 60.0
"""Time over which the offset of a barometer from GPS is a median."""
SETTLED_S = 20.0
"""Time from which a simulated flight is scored: the estimators have used their first fixes."""
GPS_NAMES = ["gps_lat", "gps_lon", "gps_alt_m", "gps_vn", "gps_ve", "gps_vd"]


@dataclass(frozen=True)
class Flight:
    """One log and its reference."""

    name: str
    log: SampleLog
    reference: ReferenceSettings
    q_nb: np.ndarray
    """(n, 4), NaN where there is no reference."""
    pos_ne_m: np.ndarray
    """(n, 2) north and east of `origin_deg`, NaN where there is no reference."""
    origin_deg: tuple[float, float]
    alt_m: np.ndarray
    """(n,) height above sea level, NaN where there is no reference."""
    counts: np.ndarray
    """(n,) whether the sample is scored."""
    free_heading: bool = False
    """Whether the reference's heading has an unknown constant offset."""

    def with_gps(self, keep: np.ndarray) -> "Flight":
        """Leave out fixes."""
        log = replace(self.log, gps_time_us=self.log.gps_time_us[keep], gps=self.log.gps[keep])
        return replace(self, log=log)


def as_increments(flight: Flight, rate_hz: float) -> Flight:
    """Reduce the rate of the IMU samples of a flight as a node does for a slow link.

    Each new sample has the constant rate that gives the rotation of its interval, the constant
    force that gives the change of velocity in the axes at half of it, and the newest field.
    """
    log, size = flight.log, len(IMU_NAMES)
    step_s = np.diff(log.imu_time_us, prepend=2 * log.imu_time_us[0] - log.imu_time_us[1]) * 1e-6
    every = max(1, round(1.0 / (rate_hz * float(np.median(step_s)))))
    ends = np.arange(every - 1, len(log.imu), every)
    whole = len(ends) * every
    parts = log.imu[:whole].reshape(len(ends), every, -1)
    steps = step_s[:whole].reshape(len(ends), every, 1)
    turned, velocity = Rotation.identity(len(ends)), np.zeros((len(ends), 3))
    for k in range(every):
        angle, gained = parts[:, k, 3:6] * steps[:, k], parts[:, k, 0:3] * steps[:, k]
        velocity += (turned * Rotation.from_rotvec(0.5 * angle)).apply(gained)
        turned = turned * Rotation.from_rotvec(angle)
    half_way, span_s = Rotation.from_rotvec(0.5 * turned.as_rotvec()), steps.sum(axis=1)
    imu = log.imu[ends].copy()
    imu[:, 0:3] = half_way.inv().apply(velocity) / span_s
    imu[:, 3:6] = turned.as_rotvec() / span_s
    imu[:, MEANS] = 1.0
    known = np.isfinite(parts[:, :, 6])
    newest = every - 1 - np.argmax(known[:, ::-1], axis=1)
    imu[:, 6:size] = parts[np.arange(len(ends)), newest, 6:size]
    imu[~known.any(axis=1), 6:size] = np.nan
    return replace(
        flight,
        log=replace(log, imu_time_us=log.imu_time_us[ends], imu=imu),
        q_nb=flight.q_nb[ends],
        pos_ne_m=flight.pos_ne_m[ends],
        alt_m=flight.alt_m[ends],
        counts=flight.counts[ends],
    )


def read_flight(path: Path) -> Flight:
    """Read one gzipped CSV in the common format."""
    header = pd.read_csv(path, nrows=0, sep="\x00").columns[0]
    meta = {k: float(v) for k, v in re.findall(r"(\w+)=(-?[\d.]+)", header)}
    table = pd.read_csv(path, comment="#")
    for name in [*IMU_NAMES, *QUAT_NAMES, *GPS_NAMES, "ref_n", "ref_e", "baro_alt_m", "gps_time_s"]:
        if name not in table:
            table[name] = np.nan
    n = len(table)
    counts = np.ones(n, bool)
    for name in ("in_flight", "movement"):
        if name in table:
            counts = table[name].to_numpy() == 1
    settings = ReferenceSettings(
        gps_latency_s=meta.get("gps_latency_s", 0.0),
        declination="fixed" if "declination_deg" in meta else "model",
        declination_deg=meta.get("declination_deg", 0.0),
    )
    log = _samples(table, settings)
    first = log.gps[0, 1:3] if len(log.gps) else np.zeros(2)
    origin = (meta.get("origin_lat", first[0]), meta.get("origin_lon", first[1]))
    return Flight(
        name=path.name.split(".")[0],
        log=log,
        reference=settings,
        q_nb=table[QUAT_NAMES].to_numpy(),
        pos_ne_m=table[["ref_n", "ref_e"]].to_numpy() if len(log.gps) else np.full((n, 2), np.nan),
        origin_deg=(float(origin[0]), float(origin[1])),
        alt_m=_reference_height(log, settings.gps_latency_s),
        counts=counts,
        free_heading="mocap" in path.name,
    )


def _reference_height(log: SampleLog, latency_s: float) -> np.ndarray:
    """Return the height of the fixes, between them that of the barometer plus its slow offset."""
    time_s, fix_s = log.imu_time_us * 1e-6, log.gps_time_us * 1e-6 - latency_s
    alt_m = log.gps[:, GPS_ALT]
    if not len(fix_s):
        return np.full(len(time_s), np.nan)
    if not len(log.baro_alt_m):
        return np.interp(time_s, fix_s, alt_m)
    baro_s = log.baro_time_us * 1e-6
    off_m = pd.Series(
        alt_m - np.interp(fix_s, baro_s, log.baro_alt_m), pd.to_datetime(fix_s, unit="s")
    )
    slow_m = off_m.rolling(f"{OFFSET_S:.0f}s", center=True).median()
    return np.interp(time_s, baro_s, log.baro_alt_m) + np.interp(time_s, fix_s, slow_m)


def _samples(table: pd.DataFrame, settings: ReferenceSettings) -> SampleLog:
    """Return the input of the estimators, with the declination in each fix."""
    time_us = np.round(table.time_s.to_numpy() * 1e6).astype(np.int64)
    baro = table.baro_alt_m.notna().to_numpy()
    fixes = table[table.gps_lat.notna()]
    gps = np.full((len(fixes), GPS_COLUMNS), np.nan)
    gps[:, 0] = 1.0
    gps[:, 1:7] = fixes[GPS_NAMES].to_numpy()
    earth = EarthField(settings)
    if len(gps):
        lat_deg, lon_deg, alt_m = gps[0, GPS_LAT : GPS_ALT + 1].tolist()
        earth.update(lat_deg, lon_deg, alt_m, None)
        gps[:, GPS_DECLINATION] = earth.declination_rad
        gps[:, GPS_DIP:] = math.nan if earth.field is None else earth.field[1:]
    imu = np.zeros((len(table), IMU_COLUMNS))
    imu[:, : len(IMU_NAMES)] = table[IMU_NAMES].to_numpy()
    return SampleLog(
        imu_time_us=time_us,
        imu=imu,
        baro_time_us=time_us[baro],
        baro_alt_m=table.baro_alt_m.to_numpy()[baro],
        gps_time_us=np.round(fixes.gps_time_s.to_numpy() * 1e6).astype(np.int64),
        gps=gps,
    )


def north_east_m(flight: Flight, lat_deg: np.ndarray, lon_deg: np.ndarray) -> np.ndarray:
    """Convert degrees to metres from the flight's origin, shape (n, 2)."""
    lat0, lon0 = flight.origin_deg
    meridian_m, parallel_m = radii_m(lat0, 0.0)
    north = np.radians(lat_deg - lat0) * meridian_m
    return np.column_stack([north, np.radians(lon_deg - lon0) * parallel_m])


def simulated_flight(seed: int, *, calibrated: bool) -> Flight:
    """Simulate the simulator's flight; its truth is exact.

    The magnetometer is always calibrated, the inertial sensors if `calibrated`.
    """
    flown = fly(SimulatorSettings(seed=seed))
    ideal = flown.errors
    known = ideal if calibrated else {k: v for k, v in ideal.items() if k.startswith("mag")}
    chain = SensorChain(NodeCalibration(**known))
    settings = ReferenceSettings(gps_latency_s=flown.settings.gps_latency_s)
    earth = EarthField(settings)
    imu_us, imu, baro_us, baro, gps_us, gps = [], [], [], [], [], []
    for record in flown.records():
        match record:
            case ImuRaw():
                imu_us.append(record.time_us)
                imu.append(imu_row(chain.imu(record)))
            case BaroRaw():
                baro_us.append(record.time_us)
                baro.append(chain.baro(record).alt_pressure_m)
            case GpsFix():
                gps_us.append(record.time_us)
                gps.append(gps_row(record, settings, earth))
    log = SampleLog(*(np.array(column) for column in (imu_us, imu, baro_us, baro, gps_us, gps)))
    truth = flown.trajectory.truth_at(np.asarray(log.imu_time_us * 1e-6, np.float64))
    origin = (flown.settings.home_lat_deg, flown.settings.home_lon_deg)
    flight = Flight(
        name=f"simulated {seed}{'' if calibrated else ' uncalibrated'}",
        log=log,
        reference=settings,
        q_nb=truth.q_nb,
        pos_ne_m=np.empty((0, 2)),
        origin_deg=origin,
        alt_m=truth.alt_amsl_m,
        counts=log.imu_time_us > SETTLED_S * 1e6,
    )
    return replace(flight, pos_ne_m=north_east_m(flight, truth.lat_deg, truth.lon_deg))


def run_paper(flight: Flight) -> np.ndarray:
    """Run the paper's estimator over a flight."""
    estimator = PaperEstimator(PaperSettings(), flight.reference)
    log = flight.log
    fixes = [
        _fix_of(time_us, row)
        for time_us, row in zip(log.gps_time_us.tolist(), log.gps.tolist(), strict=True)
    ]
    out, taken = [], 0
    for time_us, row in zip(log.imu_time_us.tolist(), log.imu.tolist(), strict=True):
        while taken < len(fixes) and fixes[taken].time_us <= time_us:
            estimator.update_gps(fixes[taken])
            taken += 1
        mag = tuple(row[6:9]) if math.isfinite(row[6]) else None
        flags = ImuFlags(0)
        sample = ImuSample(time_us, tuple(row[:3]), tuple(row[3:6]), mag, math.nan, flags)
        out.append(nav_row(estimator.update_imu(sample)))
    return np.array(out)


def _fix_of(time_us: int, row: list[float]) -> GpsFix:
    return GpsFix(
        time_us=time_us,
        node=NodeId(1, 1),
        node_time_us=time_us,
        itow_ms=0,
        fix_type=GpsFixType.FIX_3D if row[0] else GpsFixType.NONE,
        fix_ok=bool(row[0]),
        satellites=0,
        lat_dege7=round(row[1] * DEGE7_PER_DEG),
        lon_dege7=round(row[2] * DEGE7_PER_DEG),
        alt_amsl_m=row[3],
        vel_n_mps=(row[4], row[5], row[6]),
        h_acc_m=row[7],
        v_acc_m=row[8],
        speed_acc_mps=row[9],
    )
