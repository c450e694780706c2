"""One flight fused with every estimator, the input of all sections of a report."""

from dataclasses import dataclass
from typing import Final

import msgspec
import numpy as np

from gateway.analysis.flight_arrays import (
    Flight,
    FlightTrack,
    FusionSettings,
    LocalFrame,
    local_frame,
)
from gateway.analysis.fusion import fuse, fuse_smoothed
from gateway.estimation.select import OWN_ESTIMATORS, EstimationSettings

ESTIMATORS: Final[tuple[str, ...]] = tuple(
    name for name in OWN_ESTIMATORS if name in EstimationSettings.__struct_fields__
)
"""Every estimator has a section of settings of its own name."""

SMOOTHED: Final = "smoothed"
"""Name of the smoothed track, which uses the whole flight."""


@dataclass(frozen=True, slots=True)
class Case:
    """A flight, the settings it is fused with, and the results."""

    flight: Flight
    fusion: FusionSettings
    tracks: dict[str, FlightTrack]
    """By estimator, and `SMOOTHED` if requested."""
    frame: LocalFrame | None
    """Metres about the first fix; None in a flight without GPS."""
    smoothed_latency_s: float | None = None
    """The GPS latency of the smoothed track; another than is set where the motion contradicts."""

    @property
    def chosen(self) -> str:
        """The estimator selected in the settings."""
        return self.fusion.estimation.estimator

    @property
    def track(self) -> FlightTrack:
        """The track of the chosen estimator."""
        return self.tracks[self.chosen]

    @property
    def truth_name(self) -> str:
        """Name of the reference in a legend."""
        reference = self.flight.reference
        return "truth" if reference is not None and reference.is_exact else "reference"


def with_estimator(fusion: FusionSettings, name: str) -> FusionSettings:
    """Choose another estimator."""
    estimation = msgspec.structs.replace(fusion.estimation, estimator=name)
    return msgspec.structs.replace(fusion, estimation=estimation)


def make_case(
    flight: Flight, fusion: FusionSettings | None = None, *, smooth: bool = False
) -> Case:
    """Fuse a flight with every estimator."""
    fusion = fusion or flight.fusion
    tracks = {name: fuse(flight, with_estimator(fusion, name)) for name in ESTIMATORS}
    latency_s = None
    if smooth and not np.any(np.diff(flight.time_us) < 0):
        tracks[SMOOTHED], latency_s = fuse_smoothed(flight, fusion)
    return Case(flight, fusion, tracks, local_frame(flight), latency_s)
