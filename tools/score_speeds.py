"""How fast estimators are over a whole log at once and sample by sample, ours and VQF."""

import math
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from gateway.estimation.columns import ACCEL, CLIPPED, GYRO, MAG
from gateway.estimation.select import EstimationSettings, make_estimator
from gateway.records import ImuFlags, ImuSample
from tools.flights import Flight
from tools.peers import vqf_input

SAMPLES = 20_000
"""Of a log, sample by sample."""
REPEATS = 3
ROOM_TEMPERATURE_DEGC = 20.0


def singly_per_s(flight: Flight, name: str) -> float:
    """Return how many samples a second one of our estimators takes as they come live."""
    samples = imu_samples(flight)
    best_s = math.inf
    for _ in range(REPEATS):
        settings = EstimationSettings(estimator=name, reference=flight.reference)
        update = make_estimator(settings).update_imu
        begin = time.perf_counter()
        for sample in samples:
            update(sample)
        best_s = min(best_s, time.perf_counter() - begin)
    return len(samples) / best_s


def imu_samples(flight: Flight) -> list[ImuSample]:
    """Return the first samples of a log as the sensing stage hands them on."""
    found = []
    log = flight.log
    times = log.imu_time_us[:SAMPLES].tolist()
    for time_us, row in zip(times, log.imu[:SAMPLES].tolist(), strict=True):
        accel, gyro, mag = (tuple(row[k : k + 3]) for k in (ACCEL, GYRO, MAG))
        is_new = math.isfinite(mag[0])
        flags = (ImuFlags.MAG_NEW if is_new else ImuFlags(0)) | (
            ImuFlags.ACCEL_CLIPPED if row[CLIPPED] else ImuFlags(0)
        )
        found.append(
            ImuSample(
                *(time_us, accel, gyro, accel, gyro, mag if is_new else None),
                *(ROOM_TEMPERATURE_DEGC, flags),
            )
        )
    return found


def vqf_per_s(flight: Flight) -> tuple[float, float]:
    """Return how many samples a second VQF takes, by `updateBatch` and one by one.

    Only its own calls count. In a batch the compass has to come with every sample: the last value
    is held.
    """
    from vqf import VQF

    accel, gyro, mag, new, dt_s = vqf_input(flight)
    use_mag = bool(new.any())
    batch_s = singly_s = math.inf
    for _ in range(REPEATS):
        vqf = VQF(dt_s)
        begin = time.perf_counter()
        vqf.updateBatch(gyro, accel, np.ascontiguousarray(mag)) if use_mag else vqf.updateBatch(
            gyro, accel
        )
        batch_s = min(batch_s, time.perf_counter() - begin)
        vqf = VQF(dt_s)
        begin = time.perf_counter()
        for i in range(min(SAMPLES, len(gyro))):
            vqf.updateGyr(gyro[i])
            vqf.updateAcc(accel[i])
            if new[i]:
                vqf.updateMag(mag[i])
        singly_s = min(singly_s, time.perf_counter() - begin)
    return len(gyro) / batch_s, min(SAMPLES, len(gyro)) / singly_s
