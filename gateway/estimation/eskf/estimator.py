"""The error-state Kalman filter put together."""

from typing import Final

from gateway.estimation.eskf.fixes import take_gps
from gateway.estimation.eskf.kernels import run, take_baro, take_imu
from gateway.estimation.eskf.output import tell
from gateway.estimation.eskf.settings import EskfSettings, Gains, make_gains
from gateway.estimation.eskf.start import start
from gateway.estimation.eskf.state import State
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


class EskfEstimator(KernelEstimator[State, Gains]):
    """Causal error-state Kalman filter of 25 states; see the modules of this package.

    Parameters
    ----------
    settings : EskfSettings
        What the filter believes of its sensors.
    reference : ReferenceSettings
        GPS latency and declination.
    rest : RestSettings
        What is taken for rest.
    compass : CompassSettings
        When the compass is taken for disturbed.
    """

    def __init__(
        self,
        settings: EskfSettings,
        reference: ReferenceSettings,
        rest: RestSettings,
        compass: CompassSettings,
    ) -> None:
        super().__init__(KERNELS, make_gains(settings, reference, rest, compass), reference)
