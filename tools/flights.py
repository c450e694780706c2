"""Logs with a reference, read for scoring: samples for the estimators, truth for the judge."""

import re
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pandas as pd

from gateway.estimation.columns import GPS_COLUMNS, IMU_COLUMNS
from gateway.estimation.kernel import SampleLog
from gateway.estimation.reference import EarthField, ReferenceSettings
from gateway.geometry.geodesy import displacement_m

IMU_NAMES = ["ax", "ay", "az", "gx", "gy", "gz", "mx", "my", "mz"]
QUAT_NAMES = ["ref_qw", "ref_qx", "ref_qy", "ref_qz"]
GPS_NAMES = ["gps_lat", "gps_lon", "gps_alt_m", "gps_vn", "gps_ve", "gps_vd"]


@dataclass(frozen=True)
class Flight:
    """One log and what is known to be true of it."""

    name: str
    log: SampleLog
    reference: ReferenceSettings
    q_nb: np.ndarray
    """(n, 4), NaN where there is no reference."""
    pos_ne_m: np.ndarray
    """(n, 2) north and east of `origin_deg`, NaN where there is no reference."""
    origin_deg: tuple[float, float]
    counts: np.ndarray
    """(n,) whether the sample is scored."""
    free_heading: bool = False
    """The reference's heading holds only up to a constant."""
    extra: dict[str, np.ndarray] = field(default_factory=dict)

    def with_gps(self, keep: np.ndarray) -> "Flight":
        """Leave out fixes."""
        log = replace(self.log, gps_time_us=self.log.gps_time_us[keep], gps=self.log.gps[keep])
        return replace(self, log=log)


def read_flight(path: Path) -> Flight:
    """Read one gzipped CSV of the shared form."""
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
        declination="fixed",
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
        counts=counts,
        free_heading="mocap" in path.name,
    )


def _samples(table: pd.DataFrame, settings: ReferenceSettings) -> SampleLog:
    """Lay out the estimators' input; the declination stands in each fix."""
    time_us = np.round(table.time_s.to_numpy() * 1e6).astype(np.int64)
    baro = table.baro_alt_m.notna().to_numpy()
    fixes = table[table.gps_lat.notna()]
    gps = np.full((len(fixes), GPS_COLUMNS), np.nan)
    gps[:, 0] = 1.0
    gps[:, 1:7] = fixes[GPS_NAMES].to_numpy()
    gps[:, 10] = EarthField(settings).declination_rad
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
    """Turn degrees into metres from the flight's origin."""
    lat0, lon0 = flight.origin_deg
    return np.array(
        [displacement_m(lat0, lon0, a, b, 0.0) for a, b in zip(lat_deg, lon_deg, strict=True)]
    ).reshape(-1, 2)
