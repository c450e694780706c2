"""Compiled code, made ready before samples wait for it."""

import logging
import time
from typing import Final, get_args

from gateway.aircraft import AircraftSettings
from gateway.estimation.select import EstimationSettings, EstimatorName
from gateway.pipeline import Pipeline, PipelineSettings
from gateway.simulator.flight import fly
from gateway.simulator.settings import SimulatorSettings

log = logging.getLogger(__name__)

REHEARSAL_S: Final = 2.0
WORTH_TELLING_S: Final = 5.0


def compile_everything() -> None:
    """Let every estimator fuse two seconds of a simulated flight.

    The machine code is kept beside the source, so only the first call after an upgrade takes most
    of a minute, later ones about a second. All estimators are made ready, since a ground station
    may choose another one in flight, when a stall would cost the horizon.
    """
    log.info("making the estimators ready; the first start compiles them, up to a minute")
    begin = time.monotonic()
    flight = fly(SimulatorSettings(gps_first_fix_s=0.0), duration_s=REHEARSAL_S)
    for name in get_args(EstimatorName):
        settings = AircraftSettings(estimation=EstimationSettings(estimator=name))
        pipeline = Pipeline(PipelineSettings(settings))
        for record in flight.records():
            pipeline.take(record, record.time_us)
    if time.monotonic() - begin > WORTH_TELLING_S:
        log.info("the estimators are compiled; the next start takes a second")
