"""Compiled code, made ready before samples wait for it."""

import logging
import signal
import time
from typing import Final

from gateway.aircraft import AircraftSettings
from gateway.analysis.processes import cores, run_copies
from gateway.compiled import is_kept
from gateway.estimation.complementary import complementary_live
from gateway.estimation.eskf import eskf_live
from gateway.estimation.paper import paper_kernels
from gateway.estimation.select import OWN_ESTIMATORS, EstimationSettings
from gateway.pipeline import Pipeline, PipelineSettings
from gateway.simulator.flight import fly
from gateway.simulator.simulator_settings import SimulatorSettings

log = logging.getLogger(__name__)

REHEARSAL_S: Final = 2.0
STEPS: Final = (paper_kernels.step_live, complementary_live.imu_step, eskf_live.imu_step)


def compile_everything() -> None:
    """Let every estimator fuse two seconds of a simulated flight.

    The machine code is kept beside the source, so only the first call after an upgrade compiles,
    later ones take about a second. All estimators are made ready, since a ground station may
    choose another one in flight, when a stall would cost the horizon.
    """
    if all(is_kept(step) for step in STEPS):
        _rehearse_all()
        return
    log.info("compiling the estimators, up to a minute; later starts take a second")
    begin = time.monotonic()
    if cores() > 1:
        # A process each; this one then finds the code that they have kept, or makes it itself.
        run_copies(_rehearse_apart, OWN_ESTIMATORS)
    _rehearse_all()
    log.info("compiled in %.0f s", time.monotonic() - begin)


def _rehearse_all() -> None:
    """Fuse with every estimator in this process."""
    for name in OWN_ESTIMATORS:
        _rehearse(name)


def _rehearse_apart(name: str) -> None:
    # It is the parent that tells of an interrupt.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    _rehearse(name)


def _rehearse(name: str) -> None:
    flight = fly(SimulatorSettings(gps_first_fix_s=0.0), duration_s=REHEARSAL_S)
    settings = AircraftSettings(estimation=EstimationSettings(estimator=name))
    pipeline = Pipeline(PipelineSettings(settings))
    for record in flight.records():
        pipeline.take(record, record.time_us)
