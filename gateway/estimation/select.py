"""The choice of an estimator: the settings of all, and one made from them."""

from typing import Annotated, Literal

from gateway.estimation.complementary.complementary_live import KERNELS as COMPLEMENTARY
from gateway.estimation.complementary.complementary_state import ComplementarySettings
from gateway.estimation.complementary.complementary_state import make_gains as complementary_gains
from gateway.estimation.eskf.eskf_live import KERNELS as ESKF
from gateway.estimation.eskf.eskf_settings import EskfSettings
from gateway.estimation.eskf.eskf_settings import make_gains as eskf_gains
from gateway.estimation.interface import Estimator
from gateway.estimation.kernel import KernelEstimator
from gateway.estimation.magfield import CompassSettings
from gateway.estimation.paper.paper import PaperEstimator, PaperSettings
from gateway.estimation.reference import ReferenceSettings
from gateway.estimation.rest import RestSettings
from gateway.settings import Settings, setting

EstimatorName = Literal["paper", "complementary", "eskf"]


class EstimationSettings(Settings, frozen=True):
    """Which estimator runs, and the settings of each."""

    estimator: Annotated[EstimatorName, setting("Estimator: complementary, eskf or paper.")] = (
        "complementary"
    )
    reference: ReferenceSettings = ReferenceSettings()
    rest: RestSettings = RestSettings()
    compass: CompassSettings = CompassSettings()
    paper: PaperSettings = PaperSettings()
    complementary: ComplementarySettings = ComplementarySettings()
    eskf: EskfSettings = EskfSettings()


def make_estimator(settings: EstimationSettings) -> Estimator:
    """Build the estimator that the settings name.

    Parameters
    ----------
    settings : EstimationSettings
        The choice and every estimator's own settings.

    Returns
    -------
    Estimator
        Fresh, for one aircraft.
    """
    reference, rest, compass = settings.reference, settings.rest, settings.compass
    if settings.estimator == "complementary":
        complementary = complementary_gains(settings.complementary, reference, rest, compass)
        return KernelEstimator(COMPLEMENTARY, complementary, reference)
    if settings.estimator == "eskf":
        eskf = eskf_gains(settings.eskf, reference, rest, compass)
        return KernelEstimator(ESKF, eskf, reference)
    return PaperEstimator(settings.paper, reference, rest)
