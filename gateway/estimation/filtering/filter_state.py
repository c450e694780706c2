"""What both filters remember and are set to, whatever their model."""

from typing import Annotated

from gateway.compiled import compiled
from gateway.estimation.alignment.gps_latency import LatencyState
from gateway.estimation.alignment.gps_velocity import WayState
from gateway.estimation.alignment.review import ReviewState
from gateway.estimation.compass_lag import LagState
from gateway.estimation.filtering.bias_evidence import BiasEvidenceState
from gateway.estimation.filtering.field_jump import FieldJumpState
from gateway.estimation.filtering.hidden_pull import HiddenPullState
from gateway.estimation.filtering.iron_evidence import IronState
from gateway.estimation.filtering.roughness import RoughnessState
from gateway.estimation.filtering.uncalibrated import UncalibratedState
from gateway.estimation.flagbits import (
    AT_REST,
    DEGRADED,
    MAG_DISTURBED,
    MAG_MISPLACED,
    SENSOR_FAULT,
    USING_BARO,
    USING_MAG,
)
from gateway.estimation.kernel_record import FloatArray
from gateway.estimation.local_position import BARO_STALE_S
from gateway.estimation.magfield import (
    STALE_MAG_S,
    CompassSettings,
    FieldGains,
    FieldState,
    field_gains,
)
from gateway.estimation.reference import EarthField, ReferenceSettings
from gateway.estimation.rest import RestGains, RestSettings, RestState, rest_gains
from gateway.estimation.sensor_faults import HealthState


class FilterGains(RestGains, FieldGains):
    """The settings that both filters have, in SI units."""

    gps_latency_s: float
    gps_relock_s: float
    declination_rad: float
    """NaN where it is looked up at the place of a fix."""


def filter_gains(
    reference: ReferenceSettings, rest: RestSettings, compass: CompassSettings
) -> dict[str, float]:
    """Return the fields of `FilterGains`."""
    return {
        "gps_latency_s": reference.gps_latency_s,
        "gps_relock_s": reference.gps_relock_s,
        "declination_rad": EarthField(reference).declination_rad,
        **rest_gains(rest),
        **field_gains(compass),
    }


class FilterState(
    UncalibratedState,
    HealthState,
    RoughnessState,
    RestState,
    FieldState,
    IronState,
    HiddenPullState,
    BiasEvidenceState,
    FieldJumpState,
    LagState,
    LatencyState,
    ReviewState,
    WayState,
):
    """The part of a filter's state that says nothing of its model."""

    noise_shown: float
    """`noise_excess` over time, of a sound IMU alone; see `receiver_noise`."""
    started: int
    base_us: int
    time_us: int
    """Time of the newest sample, and of the one that `time_s` counts from."""
    usual_step_s: float
    """Time from sample to sample, on average; 0 before the second."""
    turning_sq: float
    """Mean square of the angular rate of late, of one axis, (rad/s)2."""
    imu_s: float
    """Time of the newest sample."""
    gap_s: float
    """Time from the sample before to the newest one."""
    heading_true: int
    """1 if the declination was known or the GPS gave the heading."""
    silent_s: float
    """How long a silence of the IMU has lasted since it began, or since the last fix in it."""
    silent_rad: float
    """How far the attitude may have turned in a silence of the IMU that has not ended, else 0."""
    silent_turn_rad: float
    """How far the heading has been turned on in such a silence, rad."""
    silent_rest: int
    """1 while such a silence goes on that began at rest."""
    declination_rad: float
    earth_dip_rad: float
    """Dip of the Earth's field at the place; NaN before the first fix."""
    baro_known: int
    baro_s: float
    baro_heights: Annotated[FloatArray, (2,)]
    """Pressure altitude, m: the newest, and the newest that was believed."""
    has_height: int
    """1 once a fix has told the height above the sea."""
    fix_s: float
    """Arrival of the last accepted fix."""
    fix_told: Annotated[FloatArray, (5,)]
    """Latitude, longitude and velocity of the newest fix: it may come again."""
    fix_told_s: float
    """Arrival of the first that told them."""


@compiled
def sensor_flags(s: FilterState) -> int:
    """Return which sensors are used, and whether one is at fault."""
    flags = AT_REST if s.at_rest == 1 else 0
    if s.time_s - s.mag_s < STALE_MAG_S:
        flags |= MAG_DISTURBED if s.mag_disturbed == 1 else USING_MAG
    if s.mag_misplaced == 1:
        flags |= MAG_DISTURBED | MAG_MISPLACED | DEGRADED
    if s.time_s - s.baro_s < BARO_STALE_S:
        flags |= USING_BARO
    if s.fault == 1:
        flags |= SENSOR_FAULT | DEGRADED
    return flags
