"""ArduPilot's log messages as records, by the fields that its firmware documents.

IMU, MAG (milligauss, offsets taken off), BARO, GPS with the accuracies of GPA, and what the
autopilot estimated: ATT, POS and the velocities of its Kalman filter (XKF1, of old NKF1). All in
body FRD and NED, in µs since the start. Of several sensors of a kind one is taken; firmware before
3.3 counts milliseconds (TimeMS, and T in GPS), and names the second sensor IMU2, GPS2 and so on.
"""

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, Final

from msgspec.structs import replace

from gateway.flightlog.table.autopilot import VELOCITY_AGE_US
from gateway.flightlog.table.autopilot_cells import MILLI, UT_PER_GAUSS
from gateway.flightlog.table.row import Imported
from gateway.geometry.quaternion import from_euler
from gateway.records import (
    NAN,
    UNKNOWN_VEC3,
    BaroRaw,
    GpsFix,
    GpsFixType,
    ImuCalibrated,
    ImuFlags,
    NavFlags,
    NavState,
    NodeId,
    Vec3,
)
from gateway.units import DEG_PER_DEGE7, US_PER_S

GPS_EPOCH_UNIX_US: Final = 315_964_800 * US_PER_S
LEAP_US: Final = 18 * US_PER_S
"""GPS time is ahead of UTC by so much since 2017."""
WEEK_US: Final = 604_800 * US_PER_S
LATE_US: Final = US_PER_S
"""Messages of one loop are not quite in order; one later than this has a damaged time."""
AHEAD_US: Final = 3_600 * US_PER_S
"""And so has one that jumps ahead by more."""
BELIEVED: Final = 50
"""So many messages in a row that agree about another time are right: the clock has leaped."""
LEAST_BELIEVED: Final = 3
"""And so many that nothing follows."""
FIX_2D: Final = 2
SENSOR_NUMBERS: Final = ("I", "C")
"""Columns with the number of the sensor, or Kalman filter, of a message."""
KINDS: Final = {
    "IMU": "IMU", "IMU2": "IMU", "IMU3": "IMU", "MAG": "MAG", "MAG2": "MAG", "MAG3": "MAG",
    "BARO": "BARO", "BAR2": "BARO", "BAR3": "BARO", "GPS": "GPS", "GPS2": "GPS",
    "GPA": "GPA", "GPA2": "GPA",
}  # fmt: skip
"""Kind of sensor by the name of its messages."""
SENSORS: Final = ("IMU", "MAG", "BARO", "GPS")
"""Kinds of which a log may hold several."""
ROLLOVER_US: Final = 1024 * WEEK_US
FIRST_LOG_US: Final = 1_262_304_000 * US_PER_S
"""The year 2010: nobody wrote this format before, so a receiver with an earlier date has lost count
of the weeks, which begin again every 1024."""

Message = Any
"""With the columns of its format as attributes, in the units of the format."""


def sensor_of(name: str, message: Message) -> int:
    """Return which sensor, or Kalman filter, sent a message; counted from 0."""
    number = next((n for column in SENSOR_NUMBERS if (n := getattr(message, column, None))), 0)
    return int(number) or (int(name[-1]) - 1 if name in KINDS and name[-1].isdigit() else 0)


def in_era(unix_us: int) -> int:
    """Add the weeks that a GPS receiver has lost count of."""
    lost = -(-(FIRST_LOG_US - unix_us) // ROLLOVER_US) if unix_us < FIRST_LOG_US else 0
    return unix_us + lost * ROLLOVER_US


def _own_us(name: str, message: Message) -> int:
    """Return a message's time on the autopilot's clock."""
    time_us = getattr(message, "TimeUS", None)
    if time_us is not None:
        return int(time_us)
    return 1000 * int(message.T if KINDS.get(name) == "GPS" else message.TimeMS)


class ArdupilotReader:
    """Turn the messages of one log into records.

    Parameters
    ----------
    vehicle_id : int
        Vehicle id of the records.
    sensors : mapping of str to int
        Which sensor to take of each of `SENSORS`, counted from 0; by default the first.
    """

    def __init__(self, vehicle_id: int, sensors: Mapping[str, int] = MappingProxyType({})) -> None:
        self.dropped = 0
        """Messages with an impossible time."""
        self.leaps = 0
        """How often the autopilot's clock jumped forward by more than that."""
        self.restarts = 0
        """How often it began again."""
        self.is_rolled_over = False
        """Whether a receiver has lost count of the weeks."""
        self.zero_us: int | None = None
        """The autopilot's time at the records' zero."""
        self._vehicle_id = vehicle_id
        self._newest_us = 0
        self._sensors = {**sensors, "GPA": sensors.get("GPS", 0)}
        self._held: list[tuple[int, str, Message]] = []
        """Messages whose times agree with each other, but not with those before."""
        self._mag: Vec3 | None = None
        self._fix: GpsFix | None = None
        """The newest fix, which waits for its accuracies."""
        self._place: tuple[int, float, float, float] | None = None
        self._motion: tuple[int, Vec3] | None = None
        self._handlers: dict[str, Callable[[Message, int], list[Imported]]] = {
            "IMU": self._imu, "MAG": self._magnetometer, "BARO": self._baro,
            "GPS": self._gps, "GPA": self._accuracies,
            "ATT": self._attitude, "POS": self._position, "XKF1": self._kalman,
            "NKF1": self._kalman,
        }  # fmt: skip

    @property
    def names(self) -> set[str]:
        """Names of the messages that are used."""
        return {*self._handlers, *KINDS}

    def feed(self, name: str, message: Message) -> list[Imported]:
        """Take the next message.

        Parameters
        ----------
        name : str
            Of its format.
        message : Message

        Returns
        -------
        list of Imported
            What it holds, in the order of time; nothing for most messages.
        """
        kind = KINDS.get(name, name)
        if kind not in self._handlers or sensor_of(name, message) != self._sensors.get(kind, 0):
            return []
        own_us = _own_us(name, message)
        if self.zero_us is None:
            self.zero_us = own_us
        if -LATE_US <= own_us - self.zero_us - self._newest_us <= AHEAD_US:
            self._drop_held()
            return self._take(own_us, kind, message)
        if self._held and abs(own_us - self._held[-1][0]) > LATE_US:
            self._drop_held()
        self._held.append((own_us, kind, message))
        return self._follow() if len(self._held) == BELIEVED else []

    def flush(self) -> list[Imported]:
        """Return what still waits at the end of the log."""
        held = self._follow() if len(self._held) >= LEAST_BELIEVED else []
        self._drop_held()
        return [*held, *self._flush_fix()]

    def _take(self, own_us: int, kind: str, message: Message) -> list[Imported]:
        """Handle a message at its time on the records' clock, which never goes back."""
        self._newest_us = max(self._newest_us, own_us - (self.zero_us or 0))
        waited = [] if kind == "GPA" else self._flush_fix()
        return [*waited, *self._handlers[kind](message, self._newest_us)]

    def _flush_fix(self) -> list[Imported]:
        """Return the fix that waits for its accuracies, if one does."""
        fix, self._fix = self._fix, None
        return [] if fix is None else [fix]

    def _drop_held(self) -> None:
        self.dropped += len(self._held)
        self._held.clear()

    def _follow(self) -> list[Imported]:
        """Follow the clock to the times of the held messages, and handle these."""
        held, self._held = self._held, []
        step_us = held[0][0] - (self.zero_us or 0) - self._newest_us
        self.leaps += step_us > 0
        self.restarts += step_us < 0
        # A log that begins again goes on from where it was.
        self.zero_us = (self.zero_us or 0) + min(step_us, 0)
        return [record for one in held for record in self._take(*one)]

    def _imu(self, m: Message, time_us: int) -> list[Imported]:
        mag, self._mag = self._mag, None
        return [
            ImuCalibrated(
                time_us=time_us,
                node=NodeId(self._vehicle_id, 0),
                accel_b_mps2=(m.AccX, m.AccY, m.AccZ),
                gyro_b_radps=(m.GyrX, m.GyrY, m.GyrZ),
                mag_b_ut=mag,
                temperature_degc=getattr(m, "T", getattr(m, "Temp", NAN)),
                flags=ImuFlags.MAG_NEW if mag else ImuFlags(0),
            )
        ]

    def _magnetometer(self, m: Message, _time_us: int) -> list[Imported]:
        ut = MILLI * UT_PER_GAUSS
        self._mag = (m.MagX * ut, m.MagY * ut, m.MagZ * ut)
        return []

    def _baro(self, m: Message, time_us: int) -> list[Imported]:
        node = NodeId(self._vehicle_id, 0)
        return [BaroRaw(time_us, node, time_us, m.Press, getattr(m, "Temp", NAN))]

    def _gps(self, m: Message, time_us: int) -> list[Imported]:
        fix_type = GpsFixType(min(m.Status, 3)) if m.Status >= FIX_2D else GpsFixType.NONE
        has_fix = fix_type is not GpsFixType.NONE
        course_rad = math.radians(m.GCrs)
        level = (m.Spd * math.cos(course_rad), m.Spd * math.sin(course_rad))
        utc_us = None
        # Before 3.3 TimeMS is the time of the week.
        week, week_ms = getattr(m, "GWk", 0) or getattr(m, "Week", 0), getattr(m, "GMS", None)
        week_ms = m.TimeMS if week_ms is None else week_ms
        if week and has_fix:
            counted_us = GPS_EPOCH_UNIX_US + week * WEEK_US + week_ms * 1000 - LEAP_US
            utc_us = in_era(counted_us)
            self.is_rolled_over |= utc_us != counted_us
        self._fix = GpsFix(
            time_us=time_us,
            node=NodeId(self._vehicle_id, 1),
            node_time_us=time_us,
            itow_ms=week_ms,
            fix_type=fix_type,
            fix_ok=has_fix,
            satellites=m.NSats,
            lat_dege7=round(m.Lat / DEG_PER_DEGE7),
            lon_dege7=round(m.Lng / DEG_PER_DEGE7),
            alt_amsl_m=m.Alt,
            vel_n_mps=(*level, getattr(m, "VZ", NAN)) if has_fix else UNKNOWN_VEC3,
            alt_ellipsoid_m=NAN,
            h_acc_m=NAN,
            v_acc_m=NAN,
            speed_acc_mps=NAN,
            course_acc_deg=NAN,
            pdop=NAN,
            utc_us=utc_us,
        )
        return []

    def _accuracies(self, m: Message, time_us: int) -> list[Imported]:
        """Join a fix with the receiver's accuracies, which follow it."""
        fix = self._fix
        if fix is None or fix.time_us != time_us:
            return self._flush_fix()
        north, east, down = fix.vel_n_mps
        self._fix = replace(
            fix,
            vel_n_mps=(north, east, down if getattr(m, "VV", 1) else NAN),
            h_acc_m=m.HAcc or NAN,
            v_acc_m=m.VAcc or NAN,
            speed_acc_mps=m.SAcc or NAN,
        )
        return self._flush_fix()

    def _position(self, m: Message, time_us: int) -> list[Imported]:
        self._place = (time_us, m.Lat, m.Lng, m.Alt)
        return []

    def _kalman(self, m: Message, time_us: int) -> list[Imported]:
        self._motion = (time_us, (m.VN, m.VE, m.VD))
        return []

    def _attitude(self, m: Message, time_us: int) -> list[Imported]:
        """Take the autopilot's own solution, for comparison."""
        flags = NavFlags.ATTITUDE_VALID | NavFlags.HEADING_VALID
        lat, lon, alt, vel = NAN, NAN, NAN, UNKNOWN_VEC3
        if self._place is not None and time_us - self._place[0] <= VELOCITY_AGE_US:
            _, lat, lon, alt = self._place
            flags |= NavFlags.POSITION_VALID | NavFlags.ALTITUDE_VALID
        if self._motion is not None and time_us - self._motion[0] <= VELOCITY_AGE_US:
            _, vel = self._motion
            flags |= NavFlags.VELOCITY_VALID
        angles_rad = (math.radians(degrees) for degrees in (m.Roll, m.Pitch, m.Yaw))
        return [
            NavState(
                time_us=time_us,
                q_nb=from_euler(*angles_rad),
                rate_b_radps=UNKNOWN_VEC3,
                lat_deg=lat,
                lon_deg=lon,
                alt_amsl_m=alt,
                vel_n_mps=vel,
                attitude_std_rad=UNKNOWN_VEC3,
                vel_std_mps=UNKNOWN_VEC3,
                pos_std_m=UNKNOWN_VEC3,
                flags=flags,
            )
        ]
