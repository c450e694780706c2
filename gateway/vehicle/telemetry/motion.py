"""In the air or on the ground, judged from the motion alone.

| state     | becomes   | when                            |
| --------- | --------- | ------------------------------- |
| undefined | on ground | slow and low, for `HOLD_US`     |
| undefined | in air    | fast or high, for `HOLD_US`     |
| on ground | in air    | fast or high, for `HOLD_US`     |
| in air    | on ground | slow and low, for `LANDING_US`  |

Fast is above the take-off speed; high is above the take-off height over the first good fix (not
over home, which may be set anywhere). Slow and low are below half of either, so that a hover, a
stall turn or a touch-and-go does not flip the state.
"""

import math
from typing import Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.records import NavFlags, NavState
from gateway.units import US_PER_S

UNDEFINED: Final[int] = mavlink.MAV_LANDED_STATE_UNDEFINED
ON_GROUND: Final[int] = mavlink.MAV_LANDED_STATE_ON_GROUND
IN_AIR: Final[int] = mavlink.MAV_LANDED_STATE_IN_AIR

HOLD_US: Final = 2 * US_PER_S
LANDING_US: Final = 5 * US_PER_S
SLOW: Final = 0.5
"""Share of the take-off limits below which the vehicle has come down."""


class Motion:
    """The landed state of one vehicle."""

    def __init__(self, takeoff_speed_mps: float, takeoff_height_m: float) -> None:
        self.takeoff_speed_mps = takeoff_speed_mps
        self.takeoff_height_m = takeoff_height_m
        self.landed_state: int = UNDEFINED
        self._leaning = UNDEFINED
        self._since_us = 0

    def update(self, state: NavState, ground_alt_m: float) -> None:
        """Update the landed state from one navigation state.

        Parameters
        ----------
        state : NavState
            The estimate; without a valid velocity nothing changes.
        ground_alt_m : float
            Height of the ground above mean sea level, NaN while it is not known.
        """
        leaning = self._lean(state, ground_alt_m)
        if leaning != self._leaning:
            self._leaning, self._since_us = leaning, state.time_us
        if leaning in (UNDEFINED, self.landed_state):
            return
        hold_us = LANDING_US if self.landed_state == IN_AIR else HOLD_US
        if state.time_us - self._since_us >= hold_us:
            self.landed_state = leaning

    def _lean(self, state: NavState, ground_alt_m: float) -> int:
        if not state.flags & NavFlags.VELOCITY_VALID:
            return UNDEFINED
        north, east, _ = state.vel_n_mps
        speed = math.hypot(north, east) / self.takeoff_speed_mps
        height = 0.0
        if state.flags & NavFlags.ALTITUDE_VALID and not math.isnan(ground_alt_m):
            height = (state.alt_amsl_m - ground_alt_m) / self.takeoff_height_m
        most = max(speed, height)
        if most > 1.0:
            return IN_AIR
        return ON_GROUND if most < SLOW else UNDEFINED
