"""Measure a report and a sweep of the simulated flight.

    python tools/bench_analysis.py

The baseline is the same sweep run with the live class, one sample at a time.
"""

import tempfile
import time
from pathlib import Path

from gateway.analysis.case import make_case
from gateway.analysis.processes import cores
from gateway.analysis.reporting.compose import make_report
from gateway.analysis.reporting.page import write_report
from gateway.analysis.simulated import simulated_flight
from gateway.analysis.sweep import grid, make_contest, parse_axis, pool
from gateway.estimation.select import make_estimator
from gateway.recordings.fuse import with_estimator
from gateway.records import GpsFix

RANGE = "0.1:0.9:9"


def main() -> None:
    """Print the times."""
    began = time.perf_counter()
    flight = simulated_flight()
    flown = time.perf_counter()
    case = make_case(flight)
    with tempfile.TemporaryDirectory() as folder:
        write_report(make_report(case), Path(folder))
    reported = time.perf_counter()
    axes = [parse_axis("alpha", RANGE), parse_axis("beta", RANGE)]
    contest = make_contest(flight, case.fusion, [axis.key for axis in axes])
    points = grid(axes)
    with pool(contest) as run:
        done = sum(1 for _ in run(points))
    swept = time.perf_counter()

    estimator = make_estimator(with_estimator(case.fusion, "paper").estimation)
    fixes: list[GpsFix] = list(flight.fixes)
    for sample in case.flight.samples.imu.samples():
        while fixes and fixes[0].time_us <= sample.time_us:
            estimator.update_gps(fixes.pop(0))
        estimator.update_imu(sample)
    baseline_s = time.perf_counter() - swept

    print(f"{flight.duration_s:.0f} s of flight, {len(flight.time_us)} samples, {cores()} cores")
    print(f"flying the simulation          {flown - began:6.1f} s")
    print(f"fusing and drawing the report  {reported - flown:6.1f} s")
    print(f"sweep of {done} trials           {swept - reported:6.1f} s")
    print(
        f"the same, sample by sample     {baseline_s * done / cores():6.1f} s (estimated from one)"
    )


if __name__ == "__main__":
    main()
