"""The complementary estimator put together."""

from typing import Final

from gateway.estimation.complementary.kernels import run, start, take_gps, take_imu
from gateway.estimation.complementary.navigation import take_baro
from gateway.estimation.complementary.output import tell
from gateway.estimation.complementary.state import (
    ComplementarySettings,
    Gains,
    State,
    make_gains,
)
from gateway.estimation.kernel import KernelEstimator, Kernels
from gateway.estimation.magfield import CompassSettings
from gateway.estimation.reference import ReferenceSettings
from gateway.estimation.rest import RestSettings

KERNELS: Final[Kernels[State, Gains]] = Kernels(
    declaration=State,
    start=start,
    imu=take_imu,
    baro=take_baro,
    gps=take_gps,
    tell=tell,
    run=run,
)


class ComplementaryEstimator(KernelEstimator[State, Gains]):
    """Quaternion complementary filter; see the modules of this package for its parts.

    Parameters
    ----------
    settings : ComplementarySettings
        Time constants and thresholds.
    reference : ReferenceSettings
        GPS latency and declination.
    rest : RestSettings
        What is taken for rest.
    compass : CompassSettings
        When the compass is taken for disturbed.
    """

    def __init__(
        self,
        settings: ComplementarySettings,
        reference: ReferenceSettings,
        rest: RestSettings,
        compass: CompassSettings,
    ) -> None:
        super().__init__(KERNELS, make_gains(settings, reference, rest, compass), reference)
