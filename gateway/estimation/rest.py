"""Rest detection: quiet sensors, a small rate, and no speed that is known; never in flight."""

import math
from typing import Annotated, Final

from gateway.compiled import compiled
from gateway.estimation.flagbits import FRESH_GPS_S
from gateway.estimation.kernel_record import FloatArray, as_vec, write_vec
from gateway.records import Vec3
from gateway.settings import Settings, setting
from gateway.units import RAD_PER_DEG, STANDARD_GRAVITY_MPS2

REST_TAU_S: Final = 0.5
"""Time constant of the averages that rest is judged by."""
REST_RATE_RADPS: Final = 0.5 * RAD_PER_DEG
REST_FORCE_MPS2: Final = 0.35
"""At rest mean rate and force stay this close to what they began with: 2 deg of a turn."""
REST_DRIFT_S: Final = 10.0
"""Time constant by which they may drift, as in a sensor that warms up."""
SHAKEN: Final = 5.0
"""An engine that idles shakes the gyroscope by so many times more than rest without one."""
STEADY: Final = 0.15
"""Its average stays this much closer to itself then: noise and vibration average out."""
LONGEST_TURN_S: Final = 40.0
"""What seems to turn for longer is a bias that has changed, unless the compass turns too."""
USUAL_BIAS_RADPS: Final = 6.0 * RAD_PER_DEG
"""A steady rate beyond this is more often a turn than a bias."""
UNTURNED_RAD: Final = 4.0 * math.pi
STANDING_UNTURNED_RAD: Final = 1.0
"""What seems to turn by more about the vertical, with no compass to contradict it, is a bias; the
second where fixes tell that it stands."""
REST_FORCE_SHARE: Final = 0.2
"""By so much of gravity the force of a rest may seem to be off it."""
PUSH_MPS2: Final = 0.3
PUSHED_SQ: Final = 9.0
"""A steady level force beyond both, three standard deviations of tilt, is no rest."""
PUSHED_MPS: Final = 40.0
"""No steady force pushes to more than this without a turn or a gust."""


class RestSettings(Settings, frozen=True):
    """What is taken for rest, where the gyroscope shows its bias; the same for all estimators."""

    gyro_degps: Annotated[
        float,
        setting(
            "At rest the angular rate stays this close to its average.", "deg/s", ge=0.01, le=10.0
        ),
    ] = 2.0
    accel_mps2: Annotated[
        float,
        setting(
            "At rest the specific force stays this close to its average.", "m/s2", ge=0.01, le=5.0
        ),
    ] = 0.5
    time_s: Annotated[
        float, setting("How long that must hold to be called rest.", "s", ge=0.2, le=30.0)
    ] = 1.5
    speed_mps: Annotated[
        float, setting("GPS speed above which nothing is at rest.", "m/s", ge=0.05, le=10.0)
    ] = 0.7
    bias_limit_degps: Annotated[
        float,
        setting(
            "No gyroscope bias is larger than this; an MPU6050 that nobody has calibrated may "
            "have 20.",
            "deg/s",
            ge=0.1,
            le=30.0,
        ),
    ] = 20.0


class RestGains:
    """The same in SI units."""

    bias_limit_radps: float
    rest_gyro_radps: float
    rest_accel_mps2: float
    rest_time_s: float
    rest_speed_mps: float


def rest_gains(settings: RestSettings) -> dict[str, float]:
    """Return the fields of `RestGains`."""
    return {
        "bias_limit_radps": math.radians(settings.bias_limit_degps),
        "rest_gyro_radps": math.radians(settings.gyro_degps),
        "rest_accel_mps2": settings.accel_mps2,
        "rest_time_s": settings.time_s,
        "rest_speed_mps": settings.speed_mps,
    }


class RestState:
    """What rest is judged by."""

    rest_s: float
    at_rest: int
    pushed_mps: float
    """Speed to which a steady force would have pushed by now, were it no tilt."""
    turn_s: float
    """For how long the mean rate has been that of a turn, since the compass last turned too."""
    still: int
    """1 while both sensors are as quiet as at rest."""
    lean_b: Annotated[FloatArray, (3,)]
    """By what the mean rate seems to have turned the level, in body FRD, rad."""
    lean_force_b: Annotated[FloatArray, (3,)]
    """Direction of the force when that began."""
    bias_jumped: int
    """1 once the force has not turned along: the bias is another now, and the level is wrong."""
    bias_shown: int
    """1 once a rest has shown the bias: before, it may be any."""
    shown_bias_b: Annotated[FloatArray, (3,)]
    """What it has shown, rad/s; zeros before."""
    spins: int
    """1 while a seeming rest turns faster than by a usual bias: nothing has judged it yet."""
    spun_rad: float
    """What it seems to turn by about the vertical, since the compass last turned too."""
    rest_rate_b: Annotated[FloatArray, (3,)]
    rest_force_b: Annotated[FloatArray, (3,)]
    """Mean rate and force with which a seeming rest began; they follow slowly."""
    gyro_lp: Annotated[FloatArray, (3,)]
    gyro_rest: Annotated[FloatArray, (3,)]
    """Behind `gyro_lp`: still the bias when a slow start of motion is noticed."""
    accel_lp: Annotated[FloatArray, (3,)]
    flown_s: float
    """Time in motion since the last rest."""
    flown_known: int
    """1 once the bias was learned in motion before a rest."""
    flown_bias_b: Annotated[FloatArray, (3,)]
    """The bias with which the last motion ended."""
    bias_of_rest: int
    """1 from a rest until the aircraft moves."""


@compiled
def outruns(speed_mps: float, unsure_sq: float, p: RestGains) -> bool:
    """Return whether a level speed of this variance, m2/s2, is that of motion rather than rest.

    What rolls or glides steadily is as quiet as rest, and stopping it there would be off by all of
    its speed: one standard deviation is enough to go on.
    """
    return speed_mps > p.rest_speed_mps + math.sqrt(unsure_sq)


@compiled
def begin_rest(s: RestState, gyro: Vec3, accel: Vec3) -> None:
    """Begin the means at a first sample."""
    write_vec(s.gyro_lp, gyro)
    write_vec(s.gyro_rest, gyro)
    write_vec(s.accel_lp, accel)


@compiled
def watch_rest(
    s: RestState,
    p: RestGains,
    gyro: Vec3,
    accel: Vec3,
    moving: bool,
    fix_age_s: float,
    dt: float,
) -> None:
    """Judge whether the aircraft stands: quiet sensors, small rate, no speed.

    A gyroscope that an idling engine shakes is quiet where its average is.

    Parameters
    ----------
    s : RestState
        Changed in place.
    p : RestGains
        Constants.
    gyro, accel : tuple of 3 floats
        Newest sample in body FRD, bias still in.
    moving : bool
        What GPS or dead reckoning says.
    fix_age_s : float
        Age of the newest fix, s.
    dt : float
        Time step, s.
    """
    share = min(1.0, dt / REST_TAU_S)
    gyro_sq, accel_sq, mean_sq, largest = 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        s.gyro_lp[k] += share * (gyro[k] - s.gyro_lp[k])
        s.gyro_rest[k] += share * (s.gyro_lp[k] - s.gyro_rest[k])
        s.accel_lp[k] += share * (accel[k] - s.accel_lp[k])
        gyro_sq += (gyro[k] - s.gyro_lp[k]) ** 2
        mean_sq += (s.gyro_lp[k] - s.gyro_rest[k]) ** 2
        accel_sq += (accel[k] - s.accel_lp[k]) ** 2
        largest = max(largest, abs(s.gyro_lp[k]))
    still_sq = p.rest_gyro_radps**2
    shaken = gyro_sq < SHAKEN**2 * still_sq and mean_sq < STEADY**2 * still_sq
    quiet = (
        (gyro_sq < still_sq or shaken)
        and accel_sq < p.rest_accel_mps2**2
        and largest < p.bias_limit_radps
    )
    usual = is_usual_bias(s, as_vec(s.gyro_lp))
    s.still = 1 if quiet and (usual or s.bias_shown == 0) else 0
    rests, upright = quiet and not moving, abs(upright_rate(s))
    s.spun_rad = s.spun_rad + upright * dt if rests else 0.0
    s.spins = 1 if rests and not usual else 0
    rests = rests and (s.spins == 0 or has_not_turned(s, upright, fix_age_s))
    s.rest_s = s.rest_s + dt if stays(s, dt) and rests else 0.0
    if s.rest_s == 0.0:
        write_vec(s.rest_rate_b, as_vec(s.gyro_lp))
        write_vec(s.rest_force_b, as_vec(s.accel_lp))
    s.at_rest = 1 if s.rest_s >= p.rest_time_s else 0
    if s.at_rest == 1:
        s.bias_shown = 1
        write_vec(s.shown_bias_b, as_vec(s.gyro_rest))


@compiled
def stays(s: RestState, dt: float) -> bool:
    """Return whether mean rate and force are those with which a seeming rest began."""
    rate_sq, force_sq, share = 0.0, 0.0, min(1.0, dt / REST_DRIFT_S)
    for k in range(3):
        rate_off, force_off = s.gyro_lp[k] - s.rest_rate_b[k], s.accel_lp[k] - s.rest_force_b[k]
        rate_sq += rate_off * rate_off
        force_sq += force_off * force_off
        s.rest_rate_b[k] += share * rate_off
        s.rest_force_b[k] += share * force_off
    return bool(rate_sq < REST_RATE_RADPS**2 and force_sq < REST_FORCE_MPS2**2)


@compiled
def upright_rate(s: RestState) -> float:
    """Return the mean rate about the mean force, beyond the bias that has shown itself, rad/s."""
    along, norm_sq = 0.0, 0.0
    for k in range(3):
        along += (s.gyro_lp[k] - s.shown_bias_b[k]) * s.accel_lp[k]
        norm_sq += s.accel_lp[k] ** 2
    return along / math.sqrt(norm_sq) if norm_sq > 0.0 else 0.0


@compiled
def is_usual_bias(s: RestState, rate: Vec3) -> bool:
    """Return whether a rate in body FRD, rad/s, is close to the bias that has shown itself."""
    return largest_difference(rate, as_vec(s.shown_bias_b)) < USUAL_BIAS_RADPS


@compiled
def has_not_turned(s: RestState, upright_radps: float, fix_age_s: float) -> bool:
    """Return whether what seems to turn fast has turned nothing, so that the rate is a bias.

    About a level axis it would have turned the force, which stands still and is that of a rest.
    About the vertical it would have turned the field; without a compass, what does not end is
    believed.

    Parameters
    ----------
    s : RestState
        What has been seen.
    upright_radps : float
        Size of the rate about the vertical.
    fix_age_s : float
        Age of the newest fix, s; it does not move.
    """
    x, y, z = as_vec(s.accel_lp)
    force = math.sqrt(x * x + y * y + z * z) / STANDARD_GRAVITY_MPS2
    most_rad = STANDING_UNTURNED_RAD if fix_age_s < FRESH_GPS_S else UNTURNED_RAD
    told = s.spun_rad > most_rad or upright_radps < USUAL_BIAS_RADPS
    return told and abs(force - 1.0) < REST_FORCE_SHARE


@compiled
def is_pushed(s: RestState, force_level: Vec3, unsure_sq: float, dt: float) -> bool:
    """Return whether a steady force is not gravity alone: a take-off run is as smooth as rest.

    What would have pushed to a speed that nothing here flies is a tilt that is wrong.

    Parameters
    ----------
    s : RestState
        Changed in place.
    force_level : tuple of 3 floats
        Mean specific force in a level frame, m/s2.
    unsure_sq : float
        Variance of what tilt and accelerometer make up of it in the level, m2/s4.
    dt : float
        Time step, s.
    """
    level_sq = force_level[0] * force_level[0] + force_level[1] * force_level[1]
    pushed = level_sq > PUSHED_SQ * unsure_sq + PUSH_MPS2 * PUSH_MPS2
    s.pushed_mps = s.pushed_mps + dt * math.sqrt(level_sq) if pushed else 0.0
    return pushed and may_be_pushed(s)


@compiled
def may_be_pushed(s: RestState) -> bool:
    """Return whether what pulls may be a push: a level that is wrong pulls as well."""
    turned = s.bias_jumped == 1 or s.turn_s > LONGEST_TURN_S
    return bool(s.pushed_mps < PUSHED_MPS and not turned)


@compiled
def largest_difference(a: Vec3, b: Vec3) -> float:
    """Return the largest difference of two vectors along an axis."""
    return max(abs(a[0] - b[0]), abs(a[1] - b[1]), abs(a[2] - b[2]))
