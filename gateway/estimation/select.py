"""Estimators: the interface of all, their settings, and the choice of one."""

from collections.abc import Callable, Mapping
from typing import Annotated, Any, Final, Protocol

from gateway.estimation.eskf.settings import EskfSettings, make_gains
from gateway.estimation.kernel import KernelEstimator
from gateway.estimation.paper import PaperEstimator, PaperSettings
from gateway.estimation.reference import ReferenceSettings
from gateway.records import BaroSample, GpsFix, ImuSample, NavState
from gateway.settings import Settings, setting


class Estimator(Protocol):
    """A causal fusion of samples into navigation states, one aircraft each.

    Samples come in the order of their `time_us`; the estimator handles a sample from the past, a
    gap, and a value that is not finite. No method raises on data.
    """

    def update_imu(self, sample: ImuSample) -> NavState:
        """Advance by one IMU sample and return the state at its time."""
        ...

    def update_baro(self, sample: BaroSample) -> None:
        """Use one barometer sample."""
        ...

    def update_gps(self, fix: GpsFix) -> None:
        """Use one GPS fix at its arrival; the estimator compensates the latency."""
        ...

    def snapshot(self) -> bytes:
        """Return the whole state."""
        ...

    def restore(self, snapshot: bytes) -> None:
        """Continue from a snapshot to the last bit; raises ValueError for another estimator's."""
        ...

    def reset(self) -> None:
        """Discard everything except the settings."""
        ...


Maker = Callable[["EstimationSettings"], Estimator]

ESTIMATORS: Final[dict[str, Maker]] = {}
"""By name, in the order of their numbers as a MAVLink parameter."""


def add_estimator(name: str, make: Maker) -> None:
    """Let `[estimation] estimator` name one more estimator.

    `make` builds one for one aircraft. Raises ValueError if there is an estimator of that name.
    """
    if name in ESTIMATORS:
        raise ValueError(f"there is an estimator {name!r} already")
    ESTIMATORS[name] = make


DEPRECATED: Final = {"complementary": "eskf"}
"""Names of estimators that another one has replaced."""


class EstimationSettings(Settings, frozen=True):
    """Which estimator runs, and the settings of each."""

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
    """Build the estimator that the settings name, for one aircraft."""
    return ESTIMATORS[settings.estimator](settings)


def _make_eskf(settings: EstimationSettings) -> Estimator:
    return KernelEstimator(make_gains(settings.eskf, settings.reference), settings.reference)


def _make_paper(settings: EstimationSettings) -> Estimator:
    return PaperEstimator(settings.paper, settings.reference)


add_estimator("eskf", _make_eskf)
add_estimator("paper", _make_paper)


def migrate_sections(sections: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Convert settings of earlier versions to present ones.

    The filter chain of `sensing` is part of the paper's estimator now, and `complementary` is
    `eskf`. Settings of estimators that no longer exist are left out.

    Parameters
    ----------
    sections : mapping
        Settings as builtins, such as a TOML file or a recording contains them.

    Returns
    -------
    sections : dict
        The same with present names.
    remarks : list of str
        One sentence for each change.
    """
    present: dict[str, Any] = dict(sections)
    remarks: list[str] = []
    found = present.get("estimation", {})
    if not isinstance(found, Mapping):
        return present, remarks
    estimation: dict[str, Any] = dict(found)
    if (chain := present.pop("sensing", None)) is not None:
        moved = {key: value for key, value in chain.items() if key in FILTER_KEYS}
        estimation["paper"] = moved | dict(estimation.get("paper", {}))
        remarks.append("[sensing] is [estimation.paper] now")
    name = estimation.get("estimator")
    if name in DEPRECATED:
        estimation["estimator"] = DEPRECATED[name]
        remarks.append(f"estimator {name} is deprecated, {DEPRECATED[name]} is used")
    for section in [key for key in FORMER_SECTIONS if key in estimation]:
        del estimation[section]
        remarks.append(f"[estimation.{section}] has no effect any more")
    own = estimation.get("eskf")
    if isinstance(own, Mapping) and (former := FORMER_KEYS & own.keys()):
        estimation["eskf"] = {key: value for key, value in own.items() if key not in former}
        remarks.append(f"[estimation.eskf] {', '.join(sorted(former))} has no effect any more")
    if estimation:
        present["estimation"] = estimation
    return present, remarks


FORMER_SECTIONS: Final = ("complementary", "compass", "rest")
FORMER_KEYS: Final = frozenset(
    {
        "accel_roughness",
        "gps_height_wander_m",
        "gps_wander_m",
        "gps_wander_s",
        "gyro_roughness",
        "mag_bias_ut",
        "mag_bias_walk_utprs",
        "unaided_velocity_mps",
    }
)
"""Sections and keys of earlier versions."""
FILTER_KEYS: Final = frozenset(PaperSettings.__struct_fields__)

OWN_ESTIMATORS: Final = tuple(ESTIMATORS)
"""The estimators of this package, without those of extensions."""
