"""Settings, gains and state of the complementary estimator."""

from typing import Annotated, Final

from gateway.compiled import compiled
from gateway.estimation.filtering.filter_state import FilterGains, FilterState, filter_gains
from gateway.estimation.kernel_record import FloatArray, filled_record
from gateway.estimation.magfield import CompassSettings
from gateway.estimation.reference import ReferenceSettings
from gateway.estimation.rest import RestSettings
from gateway.settings import Settings, setting
from gateway.units import RAD_PER_DEG

HEADING: Final = 3
"""Turn about down from the level frame to NED; the three before are the gyroscope's bias."""
COMPASS: Final = 4
IRON: Final = 5
"""Three from here, along the body's axes."""
TILT: Final = 8
"""Turn of the level frame about its own first two axes."""
FORCE: Final = 10
"""The accelerometer's bias."""
SCALE: Final = 13
"""The gyroscope's; the last that is estimated, so that it can be left out."""
SPEED: Final = 16
PLACE: Final = 18
"""Along the level frame's first two axes; never estimated."""
STATES: Final = 20
"""Of the Kalman filter in `drift`."""


class ComplementarySettings(Settings, frozen=True):
    """Time constants and thresholds of the complementary estimator."""

    tau_accel_s: Annotated[
        float,
        setting(
            "Time constant of the accelerometer's low-pass in the inertial frame, without GPS; in "
            "turns it becomes longer by itself. Small follows accelerations, large trusts the "
            "gyroscope; cutoff = sqrt(2) / (2 pi tau).",
            "s",
            ge=0.1,
            le=60.0,
        ),
    ] = 3.0
    coast_s: Annotated[
        float,
        setting(
            "After the loss of GPS in motion, how long the attitude runs on the gyroscope alone "
            "before the accelerometer is believed again.",
            "s",
            ge=0.0,
            le=120.0,
        ),
    ] = 30.0
    tau_heading_s: Annotated[
        float,
        setting(
            "Time in which the compass's slow error becomes another. Small takes it for noise and "
            "follows its mean, large for a constant that only GPS can reveal.",
            "s",
            ge=0.5,
            le=600.0,
        ),
    ] = 60.0
    heading_noise_deg: Annotated[
        float,
        setting("Slow error of the compass: iron, and the place.", "deg", ge=0.1, le=45.0),
    ] = 3.5
    gps_velocity_noise_mps: Annotated[
        float,
        setting(
            "Noise of the GPS velocity along an axis, unless the receiver tells more.",
            "m/s",
            ge=0.01,
            le=5.0,
        ),
    ] = 0.3
    bias_initial_degps: Annotated[
        float, setting("Gyroscope bias to be expected at the start.", "deg/s", ge=0.01, le=20.0)
    ] = 0.7
    bias_motion_degps: Annotated[
        float,
        setting(
            "Accuracy to which the gyroscope bias is learned in motion without GPS. Small learns "
            "slowly, large follows manoeuvres.",
            "deg/s",
            ge=0.01,
            le=5.0,
        ),
    ] = 0.1
    bias_rest_degps: Annotated[
        float,
        setting(
            "The same at rest, against its drift of 0.1 deg/s in 100 s.", "deg/s", ge=0.001, le=5.0
        ),
    ] = 0.03
    tau_velocity_s: Annotated[
        float,
        setting(
            "Time constant of the velocity against GPS. Small is noisy, large drifts.",
            "s",
            ge=0.01,
            le=20.0,
        ),
    ] = 0.4
    tau_position_s: Annotated[
        float,
        setting(
            "Time constant of the position against GPS. Small is noisy, large drifts.",
            "s",
            ge=0.01,
            le=20.0,
        ),
    ] = 0.4
    tau_baro_s: Annotated[
        float,
        setting("Time constant of height and climb against the barometer.", "s", ge=0.1, le=30.0),
    ] = 2.0
    tau_baro_offset_s: Annotated[
        float,
        setting(
            "Time constant of the barometer's offset against GPS height.", "s", ge=1.0, le=600.0
        ),
    ] = 60.0
    gps_gate_m: Annotated[
        float,
        setting(
            "Fixes further off than this, the receiver's own accuracy and what dead reckoning "
            "may have drifted are rejected.",
            "m",
            ge=1.0,
            le=1000.0,
        ),
    ] = 15.0
    gps_gate_mps: Annotated[
        float, setting("The same for the velocity.", "m/s", ge=0.5, le=100.0)
    ] = 6.0


class ComplementaryGains(FilterGains):
    """The settings in SI units."""

    tau_accel_s: float
    coast_s: float
    tau_heading_s: float
    heading_noise_rad: float
    gps_velocity_noise_mps: float
    bias_initial_radps: float
    bias_motion_radps: float
    bias_rest_radps: float
    tau_velocity_s: float
    tau_position_s: float
    tau_baro_s: float
    tau_baro_offset_s: float
    gps_gate_m: float
    gps_gate_mps: float


class ComplementaryState(FilterState):
    """All that the complementary estimator remembers."""

    bias_b: Annotated[FloatArray, (3,)]
    scale_b: Annotated[FloatArray, (3,)]
    """Share by which each axis of the gyroscope reads too much."""
    q_ei: Annotated[FloatArray, (4,)]
    """The gyroscope's frame to a level frame of free heading."""
    q_eb: Annotated[FloatArray, (4,)]
    q_nb: Annotated[FloatArray, (4,)]
    force_lp_i: Annotated[FloatArray, (3,)]
    force_lp_rate_i: Annotated[FloatArray, (3,)]
    force_in_i: Annotated[FloatArray, (3,)]
    force_lp_s: float
    """Time behind the low-pass; its start is a plain mean."""
    turn_lp: Annotated[FloatArray, (8,)]
    """Low-pass of the two level rows of `R_eb` and of their products with the bias."""
    turn_begins: int
    """1 if that low-pass begins anew."""
    turn_lp_rate: Annotated[FloatArray, (8,)]
    turn_in: Annotated[FloatArray, (8,)]
    tilt_sum: Annotated[FloatArray, (2,)]
    """Level corrections since the bias was last updated."""
    epoch_s: float
    gravity_tau_s: float
    """Time constant of gravity's low-pass, and what it follows from: see `unaided`."""
    unaided_scaled: Annotated[FloatArray, (2, 3)]
    """Level rate that the whole of each axis of the gyroscope makes up, low-passed, rad/s."""
    unaided_radps: float
    """Mean rate of turning."""
    unaided_pull: Annotated[FloatArray, (2,)]
    """What pulls across the level beside gravity, m/s2."""
    unaided_pull_sq: float
    """Mean square of it, m2/s4."""
    unaided_pulled: int
    """1 once something has pulled harder than a hand does, until the next rest."""
    unaided_hand_s: float
    """Until then, for how long it has moved since the last rest."""
    unaided_level_sq: float
    """Variance of the level by it, about one axis, rad2."""

    heading_rad: float
    """Turn about down from the level frame to NED."""
    compass_rad: float
    """Slow error of the compass."""
    compass_var: float
    """Within which that error is expected, rad2."""
    field_seen_s: float
    """Time behind the means that follow, see `compass_error`."""
    field_direction_b: Annotated[FloatArray, (3,)]
    strength_ut: float
    iron_b: Annotated[FloatArray, (3,)]
    """Iron that is carried along, in body FRD, uT."""
    iron_var: float
    """Variance along an axis that the iron is expected within, uT2."""
    level_dip_rad: float
    """Mean dip that the compass shows while the level is known."""
    level_dip_s: float
    """Time behind that mean."""
    accel_bias_b: Annotated[FloatArray, (3,)]
    """Error of the specific force, m/s2."""
    level_by_gps: int
    """1 while GPS velocities level the attitude, 0 while gravity's low-pass does."""
    drift_cov: Annotated[FloatArray, (STATES, STATES)]
    """Covariance of the states of `drift`; nothing of the level while gravity holds it."""
    drift_row: Annotated[FloatArray, (STATES,)]
    """Scratch: how a number that is measured depends on the states."""
    drift_gain: Annotated[FloatArray, (STATES,)]
    """Scratch."""
    carried_turn_eb: Annotated[FloatArray, (3, 3)]
    """Integral of `R_eb` since the covariance was carried on, s."""
    carried_scaled_eb: Annotated[FloatArray, (3, 3)]
    """The same of `R_eb diag(rate_b)`, rad."""
    carried_s: float
    carried_rad: float
    """Time since, and angle that the aircraft has turned by."""
    rate_density: float
    """Density of the noise of the angular rate, as rough as it was of late, rad2/s."""
    accel_bias_d: float
    """Error of the vertical acceleration, positive down."""
    baro_offset_m: float
    fix_heights: Annotated[FloatArray, (2,)]
    """Heights of fixes above the sea, m: the newest, and the newest that was believed."""
    fix_height_agreed: int
    """1 once a second one has agreed with the one that the height began at."""
    unseen_m2ps2: float
    """Variance of the velocity by samples that were lost since `fix_valid_s`."""
    clipped_mps: float
    """What force beyond an accelerometer's range may have done to the velocity since a fix."""
    fix_valid_s: float
    """When the last accepted fix was valid."""
    fix_vel: Annotated[FloatArray, (3,)]
    fix_force_i: Annotated[FloatArray, (3,)]
    told_std: Annotated[FloatArray, (3,)]
    """Standard deviations of the attitude about north, east and down, rad."""
    told_place_m: Annotated[FloatArray, (2,)]
    told_speed_mps: Annotated[FloatArray, (2,)]
    """The same of place and speed, north and east."""
    accuracy_s: float
    """When all that was carried on last."""
    accuracy_force_i: Annotated[FloatArray, (3,)]
    """Integral of the specific force then."""


def make_gains(
    settings: ComplementarySettings,
    reference: ReferenceSettings,
    rest: RestSettings,
    compass: CompassSettings,
) -> ComplementaryGains:
    """Turn the settings into a record of SI constants.

    Parameters
    ----------
    settings : ComplementarySettings
        Time constants and thresholds.
    reference : ReferenceSettings
        GPS latency.
    rest : RestSettings
        What is taken for rest.
    compass : CompassSettings
        When the compass is taken for disturbed.

    Returns
    -------
    ComplementaryGains
        For the kernels.
    """
    values = {name: getattr(settings, name) for name in settings.__struct_fields__}
    values |= {
        name.removesuffix("_degps") + "_radps": value * RAD_PER_DEG
        for name, value in values.items()
        if name.endswith("_degps")
    }
    noise_rad = settings.heading_noise_deg * RAD_PER_DEG
    values["heading_noise_rad"] = noise_rad
    values |= filter_gains(reference, rest, compass)
    return filled_record(ComplementaryGains, values)


@compiled
def states_in_use(s: ComplementaryState) -> int:
    """Return how many states there are: without GPS, none from the tilt on."""
    return STATES if s.level_by_gps == 1 else TILT
