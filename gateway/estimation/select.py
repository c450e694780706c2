"""The choice of an estimator: the settings of all, and one made from them."""

from collections.abc import Callable
from typing import Annotated, Final

from gateway.estimation.complementary.complementary_kernels import KERNELS as COMPLEMENTARY
from gateway.estimation.complementary.complementary_state import ComplementarySettings
from gateway.estimation.complementary.complementary_state import make_gains as complementary_gains
from gateway.estimation.eskf.eskf_kernels import KERNELS as ESKF
from gateway.estimation.eskf.eskf_settings import EskfSettings
from gateway.estimation.eskf.eskf_settings import make_gains as eskf_gains
from gateway.estimation.interface import Estimator
from gateway.estimation.kernel import KernelEstimator
from gateway.estimation.magfield import CompassSettings
from gateway.estimation.paper.paper import PaperEstimator, PaperSettings
from gateway.estimation.reference import ReferenceSettings
from gateway.estimation.rest import RestSettings
from gateway.settings import Settings, setting

Maker = Callable[["EstimationSettings"], Estimator]

ESTIMATORS: Final[dict[str, Maker]] = {}
"""By name, in the order of their numbers as a MAVLink parameter."""


def add_estimator(name: str, make: Maker) -> None:
    """Let the settings name one more estimator.

    Parameters
    ----------
    name : str
        What `[estimation] estimator` is set to.
    make : callable
        Builds one for one aircraft from the settings of all; see `Estimator` for what it offers.

    Raises
    ------
    ValueError
        If there is an estimator of that name.
    """
    if name in ESTIMATORS:
        raise ValueError(f"there is an estimator {name!r} already")
    ESTIMATORS[name] = make


class EstimationSettings(Settings, frozen=True):
    """Which estimator runs, and the settings of each."""

    estimator: Annotated[
        str, setting("Estimator: complementary, eskf or paper.", choices=ESTIMATORS)
    ] = "complementary"
    reference: ReferenceSettings = ReferenceSettings()
    rest: RestSettings = RestSettings()
    compass: CompassSettings = CompassSettings()
    paper: PaperSettings = PaperSettings()
    complementary: ComplementarySettings = ComplementarySettings()
    eskf: EskfSettings = EskfSettings()

    def __post_init__(self) -> None:
        """Raise ValueError if there is no such estimator."""
        if self.estimator not in ESTIMATORS:
            known = ", ".join(ESTIMATORS)
            raise ValueError(f"estimator is {self.estimator!r}, which is none of {known}")


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
    return ESTIMATORS[settings.estimator](settings)


def _make_paper(settings: EstimationSettings) -> Estimator:
    return PaperEstimator(settings.paper, settings.reference, settings.rest)


def _make_complementary(settings: EstimationSettings) -> Estimator:
    reference = settings.reference
    gains = complementary_gains(settings.complementary, reference, settings.rest, settings.compass)
    return KernelEstimator(COMPLEMENTARY, gains, reference)


def _make_eskf(settings: EstimationSettings) -> Estimator:
    reference = settings.reference
    gains = eskf_gains(settings.eskf, reference, settings.rest, settings.compass)
    return KernelEstimator(ESKF, gains, reference)


add_estimator("paper", _make_paper)
add_estimator("complementary", _make_complementary)
add_estimator("eskf", _make_eskf)

OWN_ESTIMATORS: Final = tuple(ESTIMATORS)
"""Those of the package itself."""
