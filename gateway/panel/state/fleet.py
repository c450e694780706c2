"""State of all aircraft from MAVLink: the newest messages, histories, texts, sensor frames."""

import math
from array import array
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Final

import msgspec
import pymap3d.vincenty as vincenty
from pymavlink.dialects.v20 import all as mavlink

from gateway.geometry.angle import wrap_180
from gateway.recordings.newest import NewestState, VehicleComponents
from gateway.recordings.positions import TrackPoint, is_located
from gateway.recordings.status_texts import JoinedText, TextJoiner
from gateway.records import NAN, UNKNOWN_VEC3
from gateway.units import DEGE7_PER_DEG, US_PER_S
from gateway.vehicle.plan import Location
from gateway.wire.mavlink_splitter import message_id_of


def command_long(system_id: int, number: int, *params: float) -> Any:
    """Make a COMMAND_LONG for an autopilot; parameters that are not given are zero."""
    filled = (*map(float, params), *(0.0,) * (7 - len(params)))
    autopilot = mavlink.MAV_COMP_ID_AUTOPILOT1
    return mavlink.MAVLink_command_long_message(system_id, autopilot, number, 0, *filled)


LIVE: Final = "live"
"""Origin of an aircraft that is not played."""


class Instant(msgspec.Struct, frozen=True, kw_only=True):
    """State of an aircraft at one moment.

    Everything is the newest from MAVLink, of any sender; NaN (null in the browser) means unknown.
    """

    system_id: int
    time_us: int
    """When the newest attitude or position came, on the panel's clock."""
    title: str
    """Displayed name."""
    model: str
    """Its 3D model, see `VehicleState.model`."""
    origin: str
    """`live`, `recorded` or `fused again`."""
    generation: int
    """How often its path was restarted."""
    silent_s: float
    """Since the newest heartbeat."""
    q_nb: tuple[float, float, float, float]
    """Attitude, scalar first, body FRD to NED."""
    rate_b_radps: tuple[float, float, float]
    lat_deg: float
    lon_deg: float
    alt_amsl_m: float
    alt_home_m: float
    """Above home."""
    vel_n_mps: tuple[float, float, float]
    groundspeed_mps: float
    airspeed_mps: float
    """Unknown where the vehicle sends its ground speed for want of a sensor."""
    climb_mps: float
    heading_deg: float
    pos_std_m: float
    """Horizontal standard deviation of the position, root of the sum of both axes."""
    fix_type: int
    """GPS_FIX_TYPE; 0 without a GPS."""
    satellites: float
    """Unknown where the receiver does not count them."""
    fix: Location | None
    """Newest GPS fix of two dimensions or more."""
    home: Location | None
    mark: Location | None
    mark_distance_m: float
    mark_bearing_deg: float
    battery_v: float
    battery_percent: float
    armed: bool
    attitude_s: float
    """Age of the newest attitude, as the others below."""
    position_s: float
    hud_s: float
    gps_s: float
    battery_s: float


MAX_TEXTS: Final = 500
MAX_LETTERS: Final = 2_000
"""Longer texts are cut there."""


@dataclass(frozen=True, slots=True)
class TimedText:
    """One text."""

    number: int
    """Counts up from 1, so that a page knows which are new."""
    time_us: int
    """On the panel's clock."""
    severity: int
    """MAV_SEVERITY: 0 emergency to 7 debug."""
    text: str


class StatusTexts:
    """The texts of one aircraft, the oldest first."""

    def __init__(self) -> None:
        self.all: deque[TimedText] = deque(maxlen=MAX_TEXTS)
        self._count = 0
        self._joiner = TextJoiner()

    def take(self, message: Any, now_us: int) -> None:
        """Take one STATUSTEXT; the chunks of a long one go into one entry, blanks into none."""
        self._add(self._joiner.feed(bytes(message.get_msgbuf()), now_us))

    def poll(self, now_us: int) -> None:
        """Add the texts whose last chunks are lost."""
        self._add(self._joiner.poll(now_us))

    def flush(self) -> None:
        """Add the texts that are not complete."""
        self._add(self._joiner.flush())

    def _add(self, texts: Iterable[JoinedText]) -> None:
        for joined in texts:
            if text := joined.text.strip()[:MAX_LETTERS]:
                self._count += 1
                self.all.append(TimedText(self._count, joined.time_us, joined.severity, text))


MM: Final = 1e3
CM: Final = 1e2
UNKNOWN_U32: Final = 0xFFFFFFFF

MAX_TRACK: Final = 20_000
"""Moments of the history: more than an hour at 5 Hz; the oldest are dropped."""
TRACK_INTERVAL_US: Final = 200_000

PLANES: Final = frozenset((1, 16, 17, 19, 20, 21, 22, 23, 24, 25, 28))
COPTERS: Final = frozenset((2, 3, 13, 14, 15, 29, 35))
OTHERS: Final = {4: "heli", 7: "balloon", 8: "balloon", 10: "rover", 11: "boat", 12: "boat"}


HISTORY_COLUMNS: Final = {
    "lat_deg": "d", "lon_deg": "d",
    **dict.fromkeys(
        (
            "alt_amsl_m", "alt_home_m", "q_nb.0", "q_nb.1", "q_nb.2", "q_nb.3", "rate_b_radps.0",
            "rate_b_radps.1", "rate_b_radps.2", "vel_n_mps.0", "vel_n_mps.1", "vel_n_mps.2",
            "groundspeed_mps", "airspeed_mps", "climb_mps", "heading_deg", "pos_std_m", "fix_type",
            "satellites", "mark_distance_m", "mark_bearing_deg", "battery_v", "battery_percent",
        ),
        "f",
    ),
}  # fmt: skip
"""Columns of a history and their type: fields of `Instant`, `.n` for one of several numbers."""


class FlightHistory:
    """States of one aircraft as columns over time."""

    def __init__(self, limit: int = MAX_TRACK) -> None:
        self._limit = limit
        self.time_us = array("q")
        self.columns = {name: array(kind) for name, kind in HISTORY_COLUMNS.items()}

    def __len__(self) -> int:
        return len(self.time_us)

    @property
    def newest_us(self) -> int:
        """Time of the newest state; far in the past without any."""
        return self.time_us[-1] if self.time_us else -TRACK_INTERVAL_US

    def add(self, time_us: int, now: Instant) -> None:
        """Add the state of one moment."""
        self.time_us.append(time_us)
        for name, column in self.columns.items():
            field, _, index = name.partition(".")
            value = getattr(now, field)
            column.append(value[int(index)] if index else value)
        if len(self.time_us) > self._limit:
            # A quarter at once, so that moving the rest is seldom.
            for column in (self.time_us, *self.columns.values()):
                del column[: self._limit // 4]

    def clear(self) -> None:
        """Delete all states."""
        for column in (self.time_us, *self.columns.values()):
            del column[:]

    def track(self) -> list[tuple[float, float, float, int]]:
        """Return latitude, longitude, height AMSL and time of all moments."""
        names = ("lat_deg", "lon_deg", "alt_amsl_m")
        return list(zip(*(self.columns[name] for name in names), self.time_us, strict=True))


class VehicleState:
    """Everything known about one system."""

    def __init__(self, system_id: int, origin: str = LIVE, number: int | None = None) -> None:
        self.system_id = system_id
        self.origin = origin
        self.number = system_id if number is None else number
        self.generation = 0
        """How often the path was restarted."""
        self.newest: dict[str, Any] = {}
        """The newest message of its autopilot by name, as pymavlink decodes it."""
        self.state = NewestState()
        """The rules by which position, attitude and so on are taken from these."""
        self.heard_us = self.state.heard_us
        """When each came, on the panel's clock in µs."""
        self.history = FlightHistory()
        """Its states so far, a few a second."""
        self.fixes: deque[TrackPoint] = deque(maxlen=MAX_TRACK)
        """GPS fixes."""
        self.texts = StatusTexts()
        """STATUSTEXT, the newest last."""
        self.exact_mark: Location | None = None
        """The mark from the gateway's control socket, exact where MAVLink is rounded."""
        self._moved_us = 0
        self._takers: dict[str, Callable[[Any, int], None]] = {
            "STATUSTEXT": self.texts.take,
            "GPS_RAW_INT": self._take_fix,
            "ATTITUDE": self._note_motion,
            "ATTITUDE_QUATERNION": self._note_motion,
        }

    def take(self, message: Any, now_us: int) -> None:
        """Take in one decoded message of this system's autopilot."""
        name = message.get_type()
        self.newest[name] = message
        has_moved = self.state.take(name, vars(message), now_us)
        self.texts.poll(now_us)
        if taker := self._takers.get(name):
            taker(message, now_us)
        if has_moved:
            self._moved_us = now_us
            if now_us - self.history.newest_us >= TRACK_INTERVAL_US:
                self.history.add(now_us, self.instant(now_us))

    @property
    def name(self) -> str:
        """Its kind and its number."""
        kind = "Aircraft" if self.model == "none" else self.model.capitalize()
        return f"{kind} {self.number}"

    @property
    def title(self) -> str:
        """Displayed name, which indicates where it is not live."""
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
        """Return how long no heartbeat came; infinite if none ever did."""
        return self.state.age_us(now_us, "HEARTBEAT") / US_PER_S

    @property
    def model(self) -> str:
        """Its 3D model: `plane`, `copter`, `heli`, `rover`, `boat`, `balloon`, `none`."""
        heartbeat = self.newest.get("HEARTBEAT")
        kind = -1 if heartbeat is None else heartbeat.type
        if kind in PLANES:
            return "plane"
        return "copter" if kind in COPTERS else OTHERS.get(kind, "none")

    @property
    def home(self) -> Location | None:
        """Home, if known."""
        message = self.newest.get("HOME_POSITION")
        if message is None or not is_located(message.latitude, message.longitude):
            return None
        return Location(
            message.latitude / DEGE7_PER_DEG,
            message.longitude / DEGE7_PER_DEG,
            message.altitude / MM,
        )

    def instant(self, now_us: int) -> Instant:
        """Return the present state."""
        get, state = self.newest.get, self.state
        (q_nb, rates), (battery_v, battery_percent) = state.attitude(), state.battery()
        at, hud, fix = state.position, get("VFR_HUD"), get("GPS_RAW_INT")
        mark, distance_m, bearing_deg = self._mark()
        return Instant(
            system_id=self.system_id,
            time_us=self._moved_us,
            title=self.title,
            model=self.model,
            origin=self.origin,
            generation=self.generation,
            silent_s=self.silent_s(now_us),
            q_nb=q_nb,
            rate_b_radps=rates,
            lat_deg=at.lat_deg if at else NAN,
            lon_deg=at.lon_deg if at else NAN,
            alt_amsl_m=at.alt_amsl_m if at else (hud.alt if hud else NAN),
            alt_home_m=at.alt_home_m if at else NAN,
            vel_n_mps=at.vel_n_mps if at else UNKNOWN_VEC3,
            groundspeed_mps=hud.groundspeed if hud else (at.groundspeed_mps if at else NAN),
            airspeed_mps=state.airspeed_mps(),
            climb_mps=hud.climb if hud else NAN,
            heading_deg=state.heading_deg(),
            pos_std_m=self._pos_std_m(),
            fix_type=fix.fix_type if fix else 0,
            satellites=state.satellites(),
            fix=_spot_of_fix(fix),
            home=self.home,
            mark=mark,
            mark_distance_m=distance_m,
            mark_bearing_deg=bearing_deg,
            battery_v=battery_v,
            battery_percent=battery_percent,
            attitude_s=self._age_s(now_us, "ATTITUDE_QUATERNION", "ATTITUDE"),
            position_s=(now_us - state.position_us) / US_PER_S if at else NAN,
            hud_s=self._age_s(now_us, "VFR_HUD"),
            gps_s=self._age_s(now_us, "GPS_RAW_INT"),
            battery_s=self._age_s(now_us, "BATTERY_STATUS", "SYS_STATUS"),
            armed=state.is_armed(),
        )

    def _age_s(self, now_us: int, *names: str) -> float:
        """Return the age of the newest of some messages; NaN if none came."""
        age_us = self.state.age_us(now_us, *names)
        return NAN if math.isinf(age_us) else age_us / US_PER_S

    def _pos_std_m(self) -> float:
        """Return the position's standard deviation: the estimator's, or the GPS receiver's."""
        estimator, fix = self.newest.get("ESTIMATOR_STATUS"), self.newest.get("GPS_RAW_INT")
        if estimator and math.isfinite(estimator.pos_horiz_accuracy):
            return float(estimator.pos_horiz_accuracy)
        return fix.h_acc / MM if fix and 0 < fix.h_acc < UNKNOWN_U32 else NAN

    def _mark(self) -> tuple[Location | None, float, float]:
        """Return the mark, and the distance and bearing reported by the aircraft."""
        way, at = self.newest.get("NAV_CONTROLLER_OUTPUT"), self.state.position
        if way is None or at is None or not way.wp_dist:
            return self.exact_mark, NAN, NAN
        bearing_deg, distance_m = float(way.target_bearing % 360), float(way.wp_dist)
        if self.exact_mark is not None:
            return self.exact_mark, distance_m, bearing_deg
        lat_deg, lon_deg = vincenty.vreckon(at.lat_deg, at.lon_deg, distance_m, bearing_deg)
        lon_deg = wrap_180(float(lon_deg))
        return Location(float(lat_deg), lon_deg), distance_m, bearing_deg

    def _note_motion(self, _message: Any, now_us: int) -> None:
        self._moved_us = now_us

    def _take_fix(self, message: Any, now_us: int) -> None:
        spot = _spot_of_fix(message)
        if spot is None:
            return
        last = self.fixes[-1] if self.fixes else None
        if last is None or (last.lat_deg, last.lon_deg) != (spot.lat_deg, spot.lon_deg):
            self.fixes.append(TrackPoint(now_us, spot.lat_deg, spot.lon_deg, spot.alt_amsl_m))


def _spot_of_fix(message: Any) -> Location | None:
    if message is None or message.fix_type < mavlink.GPS_FIX_TYPE_2D_FIX:
        return None
    if not is_located(message.lat, message.lon):
        return None
    return Location(message.lat / DEGE7_PER_DEG, message.lon / DEGE7_PER_DEG, message.alt / MM)


MAX_VEHICLES: Final = 32
"""More are forged; each may take some MB."""

Listener = Callable[[int, Any, int], None]
"""Called with system id, decoded message and time in µs on the panel's clock."""


@dataclass(frozen=True, slots=True)
class Origin:
    """Origin of an aircraft that is not live."""

    word: str
    """`recorded` or `fused again`."""
    recorded_id: int
    """Its recorded system id."""
    page: str = ""
    """Id of the page that plays it, the only one that shows it."""


class FleetState:
    """State from MAVLink, by system id."""

    def __init__(self) -> None:
        self.vehicles: dict[int, VehicleState] = {}
        self.origins: dict[int, Origin] = {}
        """Of played aircraft, by their played system ids."""
        self.version = 0
        """Counts the messages, so that a reader knows whether there is new data."""
        self._components = VehicleComponents()
        self._listeners: list[Listener] = []
        self._on_discard: list[Callable[[int], None]] = []

    def visible(self, page: str) -> dict[int, VehicleState]:
        """Return the aircraft that a page shows: live ones, and those that it plays itself."""
        return {
            system_id: vehicle
            for system_id, vehicle in self.vehicles.items()
            if (origin := self.origins.get(system_id)) is None or (page and origin.page == page)
        }

    def listen(self, listener: Listener) -> Callable[[], None]:
        """Call a listener with every message, until the returned function is called."""
        self._listeners.append(listener)

        def leave() -> None:
            if listener in self._listeners:
                self._listeners.remove(listener)

        return leave

    def on_discard(self, callback: Callable[[int], None]) -> None:
        """Call a function with the system id of every aircraft that is discarded."""
        self._on_discard.append(callback)

    def discard(self, system_id: int) -> None:
        """Discard an aircraft and its origin."""
        self.vehicles.pop(system_id, None)
        self.origins.pop(system_id, None)
        self.version += 1
        for callback in self._on_discard:
            callback(system_id)

    def take(self, message: Any, now_us: int) -> None:
        """Take in a decoded message; those of ground stations and other components are ignored."""
        system_id, component_id = message.get_srcSystem(), message.get_srcComponent()
        is_beat = message.get_msgId() == mavlink.MAVLINK_MSG_ID_HEARTBEAT
        autopilot = message.autopilot if is_beat else None
        if not self._components.includes(system_id, component_id, autopilot):
            return
        vehicle = self.vehicles.get(system_id)
        if vehicle is None:
            if len(self.vehicles) >= MAX_VEHICLES:
                return
            vehicle = VehicleState(system_id)
            if origin := self.origins.get(system_id):
                vehicle = VehicleState(system_id, origin.word, origin.recorded_id)
            self.vehicles[system_id] = vehicle
        vehicle.take(message, now_us)
        self.version += 1
        for listener in self._listeners:
            listener(system_id, message, now_us)


SPAN_US: Final = 180 * US_PER_S
MAX_FRAMES: Final = 40_000
"""Three minutes at 200 a second; less at a higher rate."""

SENSOR_MESSAGES: Final = frozenset(
    {
        mavlink.MAVLINK_MSG_ID_HIGHRES_IMU,
        mavlink.MAVLINK_MSG_ID_RAW_IMU,
        mavlink.MAVLINK_MSG_ID_SCALED_IMU,
        mavlink.MAVLINK_MSG_ID_GPS_RAW_INT,
        mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE,
    }
)

TimedFrames = list[tuple[int, bytes]]
"""When each came, in µs on the panel's clock, and the frame."""


class SampleMemory:
    """Sensor frames of each aircraft."""

    def __init__(self) -> None:
        self._frames: dict[int, deque[tuple[int, bytes]]] = {}

    def take(self, system_id: int, message: Any, now_us: int) -> None:
        """Store a message, if it is a sensor's."""
        if message.get_msgId() not in SENSOR_MESSAGES:
            return
        frames = self._frames.setdefault(system_id, deque(maxlen=MAX_FRAMES))
        frames.append((now_us, bytes(message.get_msgbuf())))
        while frames[0][0] < now_us - SPAN_US:
            frames.popleft()

    def discard(self, system_id: int) -> None:
        """Delete the frames of an aircraft."""
        self._frames.pop(system_id, None)

    def frames(self, system_id: int) -> TimedFrames:
        """Return the frames of an aircraft, the oldest first."""
        return list(self._frames.get(system_id, ()))

    def collected(self, system_id: int, span_s: float, rate_hz: float) -> float:
        """Return the collected share of a span up to the newest sample at a rate, at most 1."""
        frames = self._frames.get(system_id, ())
        newest_us = frames[-1][0] if frames else 0
        counts, first_us = Counter[int](), dict[int, int]()
        for time_us, frame in reversed(frames):
            if newest_us - time_us > (span_s + 1.0) * US_PER_S:
                break
            kind = message_id_of(frame)
            counts[kind] += 1
            first_us[kind] = time_us
        shares = (
            min(count / (span_s * rate_hz), (newest_us - first_us[kind]) / US_PER_S / span_s)
            for kind, count in counts.items()
        )
        return min(1.0, max(shares, default=0.0))
