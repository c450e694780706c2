"""State of one aircraft: its newest messages, texts, and path."""

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final

import pymap3d.vincenty as vincenty
from pymavlink.dialects.v20 import all as mavlink

from gateway.geometry.angle import wrap_180
from gateway.panel.state.fields import FieldHistory, SampleMemory
from gateway.panel.state.history import MAX_TRACK, TRACK_INTERVAL_US, FlightHistory, Instant
from gateway.records import NAN
from gateway.units import US_PER_S
from gateway.vehicle.plan import Location
from gateway.vehicle_state.newest import NewestState
from gateway.vehicle_state.positions import (
    GPS_IDS,
    UNKNOWN_U16,
    Position,
    TrackPoint,
    named_position,
    position_of,
)
from gateway.vehicle_state.status_texts import JoinedText, TextJoiner

AVIONICS: Final = mavlink.MAV_BATTERY_FUNCTION_AVIONICS
LIVE: Final = "live"
"""Origin of an aircraft that is not played."""
ATTITUDES: Final = ("ATTITUDE_QUATERNION", "ATTITUDE")
UNKNOWN_POSITION: Final = Position(NAN, NAN)
PLANES: Final = frozenset((1, 16, 17, 19, 20, 21, 22, 23, 24, 25, 28))
COPTERS: Final = frozenset((2, 3, 13, 14, 15, 29, 35))
OTHERS: Final = {4: "heli", 7: "balloon", 8: "balloon", 10: "rover", 11: "boat", 12: "boat"}
MAX_TEXTS: Final = 500
MAX_LETTERS: Final = 2_000
"""Maximum characters; longer texts are cut."""


@dataclass(frozen=True, slots=True)
class TimedText:
    """One text."""

    number: int
    """Counts up from 1, so that a page can find the new ones."""
    time_us: int
    """Time on the panel's clock."""
    severity: int
    """MAV_SEVERITY: 0 emergency to 7 debug."""
    text: str


class StatusTexts:
    """The texts of one aircraft, the oldest first."""

    def __init__(self) -> None:
        self.all: deque[TimedText] = deque(maxlen=MAX_TEXTS)
        self._count = 0
        self._joiner = TextJoiner()

    def feed(self, message: Any, now_us: int) -> None:
        """Add one STATUSTEXT; chunks of a long text share an entry, blank texts are ignored."""
        self._add(self._joiner.feed(bytes(message.get_msgbuf()), now_us))

    def poll(self, now_us: int) -> None:
        """Add the texts whose last chunks are lost."""
        self._add(self._joiner.poll(now_us))

    def _add(self, texts: Iterable[JoinedText]) -> None:
        for joined in texts:
            if text := joined.text.strip()[:MAX_LETTERS]:
                self._count += 1
                self.all.append(TimedText(self._count, joined.time_us, joined.severity, text))


class VehicleState:
    """State of one system."""

    def __init__(self, system_id: int, origin: str = LIVE, number: int | None = None) -> None:
        self.system_id = system_id
        self.origin = origin
        self.number = system_id if number is None else number
        self.generation = 0
        """Number of restarts of the path."""
        self.state = NewestState()
        """The newest messages of its autopilot, with their times on the panel's clock."""
        self.history = FlightHistory()
        self.received, self.samples = FieldHistory(), SampleMemory()
        self.fixes: deque[TrackPoint] = deque(maxlen=MAX_TRACK)
        self.texts = StatusTexts()
        self.exact_mark: Location | None = None
        """The exact mark from the gateway's control socket; that from MAVLink is rounded."""

    def update(self, message: Any, now_us: int) -> None:
        """Update the state by one decoded message of this system's autopilot."""
        name = message.get_type()
        has_moved = self.state.update(name, vars(message), now_us)
        self.texts.poll(now_us)
        if name == "STATUSTEXT":
            self.texts.feed(message, now_us)
        elif name == "GPS_RAW_INT":
            self._note_fix(now_us)
        if has_moved and now_us - self.history.newest_us >= TRACK_INTERVAL_US:
            self.history.add(now_us, self.instant(now_us))
        self.received.add(message, now_us)
        self.samples.add(message, now_us)

    @property
    def name(self) -> str:
        """Its kind and number."""
        kind = "Aircraft" if self.model == "none" else self.model.capitalize()
        return f"{kind} {self.number}"

    @property
    def title(self) -> str:
        """Displayed name, with its origin if it is not live."""
        return self.name if self.is_live else f"{self.name}, {self.origin}"

    @property
    def is_live(self) -> bool:
        """Whether it is not played from a recording."""
        return self.origin == LIVE

    def restart_path(self) -> None:
        """Restart the path, as after a seek in a recording."""
        self.history.clear()
        self.fixes.clear()
        self.generation += 1

    def silent_s(self, now_us: int) -> float:
        """Return the time since the newest heartbeat; infinite before the first."""
        return self.state.age_us(now_us, "HEARTBEAT") / US_PER_S

    @property
    def model(self) -> str:
        """Its 3D model: `plane`, `copter`, `heli`, `rover`, `boat`, `balloon`, `none`."""
        kind = self.state.kind()
        if kind in PLANES:
            return "plane"
        return "copter" if kind in COPTERS else OTHERS.get(kind, "none")

    @property
    def home(self) -> Location | None:
        """Home, if known."""
        fields = self.state.fields.get("HOME_POSITION")
        return None if fields is None else _location(named_position(fields))

    @property
    def fix(self) -> Location | None:
        """The newest GPS fix of two dimensions or more."""
        fields = self.state.fields.get("GPS_RAW_INT")
        return None if fields is None else _location(position_of(GPS_IDS[0], fields))

    def instant(self, now_us: int) -> Instant:
        """Return the present state."""
        state, gps = self.state, self.state.fix()
        (q_nb, rates), (battery_v, battery_percent) = state.attitude(), state.battery()
        at, hud = state.position or UNKNOWN_POSITION, state.fields.get("VFR_HUD")
        attitudes_us = (state.heard_us.get(name, 0) for name in ATTITUDES)
        return Instant(
            system_id=self.system_id,
            time_us=max(*attitudes_us, state.position_us, 0),
            title=self.title,
            model=self.model,
            origin=self.origin,
            generation=self.generation,
            silent_s=self.silent_s(now_us),
            q_nb=q_nb,
            rate_b_radps=rates,
            lat_deg=at.lat_deg,
            lon_deg=at.lon_deg,
            alt_amsl_m=hud["alt"] if hud and not state.position else at.alt_amsl_m,
            alt_home_m=self._alt_home_m(at),
            vel_n_mps=at.vel_n_mps,
            groundspeed_mps=hud["groundspeed"] if hud else at.groundspeed_mps,
            airspeed_mps=state.airspeed_mps(),
            climb_mps=hud["climb"] if hud else NAN,
            heading_deg=state.heading_deg(),
            pos_std_m=self._pos_std_m(),
            fix_type=gps.fix_type if gps else 0,
            satellites=state.satellites(),
            fix=self.fix,
            home=self.home,
            mark=self._mark(),
            battery_v=battery_v,
            battery_name=self.battery_name,
            battery_percent=battery_percent,
            attitude_s=self._age_s(now_us, *ATTITUDES),
            position_s=(now_us - state.position_us) / US_PER_S if state.position else NAN,
            hud_s=self._age_s(now_us, "VFR_HUD"),
            gps_s=self._age_s(now_us, "GPS_RAW_INT"),
            battery_s=self._age_s(now_us, "BATTERY_STATUS", "SYS_STATUS"),
            armed=state.is_armed(),
        )

    @property
    def battery_name(self) -> str:
        """Name of the voltage: that of the aircraft's battery, or of the supply of its boards."""
        fields = self.state.fields.get("BATTERY_STATUS")
        is_supply = fields is not None and fields["battery_function"] == AVIONICS
        return "Board supply" if is_supply else "Battery"

    def _alt_home_m(self, at: Position) -> float:
        if math.isfinite(at.alt_home_m) or self.home is None:
            return at.alt_home_m
        return at.alt_amsl_m - self.home.alt_amsl_m

    def _age_s(self, now_us: int, *names: str) -> float:
        """Return the age of the newest of some messages; NaN if none was received."""
        age_us = self.state.age_us(now_us, *names)
        return NAN if math.isinf(age_us) else age_us / US_PER_S

    def _pos_std_m(self) -> float:
        """Return the position's standard deviation: the estimator's, or the GPS receiver's."""
        estimator, gps = self.state.fields.get("ESTIMATOR_STATUS"), self.state.fix()
        if estimator and math.isfinite(estimator["pos_horiz_accuracy"]):
            return float(estimator["pos_horiz_accuracy"])
        return gps.h_acc_m if gps else NAN

    def _mark(self) -> Location | None:
        """Return the mark, from the distance and bearing that the aircraft reports if need be."""
        way, at = self.state.fields.get("NAV_CONTROLLER_OUTPUT"), self.state.position
        if self.exact_mark is not None or way is None or at is None:
            return self.exact_mark
        distance_m = float(way["wp_dist"])
        if not 0.0 < distance_m < UNKNOWN_U16:
            # The field saturates at 65 km.
            return None
        bearing_deg = float(way["target_bearing"] % 360)
        lat_deg, lon_deg = vincenty.vreckon(at.lat_deg, at.lon_deg, distance_m, bearing_deg)
        return Location(float(lat_deg), wrap_180(float(lon_deg)))

    def _note_fix(self, now_us: int) -> None:
        if (at := self.fix) is None:
            return
        last = self.fixes[-1] if self.fixes else None
        if last is None or (last.lat_deg, last.lon_deg) != (at.lat_deg, at.lon_deg):
            self.fixes.append(TrackPoint(now_us, at.lat_deg, at.lon_deg, at.alt_amsl_m))


def _location(at: Position | None) -> Location | None:
    return None if at is None else Location(at.lat_deg, at.lon_deg, at.alt_amsl_m)
