"""Estimators: their common interface, their settings, and the selection of one."""

from collections.abc import Callable
from typing import Annotated, Final, Protocol

from gateway.estimation.eskf.settings import EskfSettings, make_gains
from gateway.estimation.kernel import KernelEstimator
from gateway.estimation.paper import PaperEstimator, PaperSettings
from gateway.estimation.reference import ReferenceSettings
from gateway.records import BaroSample, GpsFix, ImuSample, NavState
from gateway.settings import Settings, setting


class Estimator(Protocol):
    """A causal fusion of the samples of one aircraft into navigation states.

    Samples are passed in the order of their `time_us`; the estimator handles samples from the past,
    gaps, and values that are not finite. No method raises on data.
    """

    def update_imu(self, sample: ImuSample) -> NavState:
        """Advance by one IMU sample and return the state at its time."""

    def update_baro(self, sample: BaroSample) -> None:
        """Use one barometer sample."""

    def update_gps(self, fix: GpsFix) -> None:
        """Use one GPS fix at its arrival; the estimator compensates the latency."""

    def snapshot(self) -> bytes:
        """Return the complete state."""

    def restore(self, snapshot: bytes) -> None:
        """Continue exactly from a snapshot; raises ValueError for that of another estimator."""

    def reset(self) -> None:
        """Discard everything except the settings."""


Maker = Callable[["EstimationSettings"], Estimator]

ESTIMATORS: Final[dict[str, Maker]] = {}
"""Estimators by name, in the order of their numbers as a MAVLink parameter."""


def add_estimator(name: str, make: Maker) -> None:
    """Register an estimator for the setting `estimator` of `[estimation]`.

    `make` builds one for one aircraft. Raises ValueError if the name is already used.
    """
    if name in ESTIMATORS:
        raise ValueError(f"there is an estimator {name!r} already")
    ESTIMATORS[name] = make


class EstimationSettings(Settings, frozen=True):
    """Selection and settings of the estimators."""

    estimator: Annotated[str, setting("Estimator: eskf or paper.", choices=ESTIMATORS)] = "eskf"
    reference: ReferenceSettings = ReferenceSettings()
    eskf: EskfSettings = EskfSettings()
    paper: PaperSettings = PaperSettings()

    def __post_init__(self) -> None:
        """Raise ValueError if there is no such estimator."""
        if self.estimator not in ESTIMATORS:
            known = ", ".join(ESTIMATORS)
            raise ValueError(f"unknown estimator {self.estimator!r}; choose {known}")


def make_estimator(settings: EstimationSettings) -> Estimator:
    """Build the estimator of the settings for one aircraft."""
    return ESTIMATORS[settings.estimator](settings)


add_estimator("eskf", lambda s: KernelEstimator(make_gains(s.eskf, s.reference), s.reference))
add_estimator("paper", lambda s: PaperEstimator(s.paper, s.reference))
OWN_ESTIMATORS: Final = tuple(ESTIMATORS)
"""The estimators of this package, without those of extensions."""
