"""The choice of an estimator: the settings of all, and one made from them."""

from typing import Annotated, Literal

from gateway.estimation.complementary.estimator import ComplementaryEstimator
from gateway.estimation.complementary.state import ComplementarySettings
from gateway.estimation.eskf.estimator import EskfEstimator
from gateway.estimation.eskf.settings import EskfSettings
from gateway.estimation.interface import Estimator
from gateway.estimation.magfield import CompassSettings
from gateway.estimation.paper import PaperEstimator, PaperSettings
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
        return ComplementaryEstimator(settings.complementary, reference, rest, compass)
    if settings.estimator == "eskf":
        return EskfEstimator(settings.eskf, reference, rest, compass)
    return PaperEstimator(settings.paper, reference, rest)
