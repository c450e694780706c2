"""ArduPilot's log messages as records, by the fields that its firmware documents.

IMU, MAG (milligauss, offsets taken off), BARO, GPS with the accuracies of GPA, and what the
autopilot estimated: ATT, POS and the velocities of its Kalman filter (XKF1, of old NKF1). All in
body FRD and NED, in µs since the start. Of several sensors of a kind the first is taken.
"""

import math
from collections.abc import Callable
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
FIX_2D: Final = 2
SENSOR_NUMBERS: Final = ("I", "C")
"""Columns with the number of the sensor, or Kalman filter, of a message."""

Message = Any
"""With the columns of its format as attributes, in the units of the format."""


class ArdupilotReader:
    """Turn the messages of one log into records.

    Parameters
    ----------
    vehicle_id : int
        Vehicle id of the records.
    """

    def __init__(self, vehicle_id: int) -> None:
        self.dropped = 0
        """Messages with an impossible time."""
        self.leaps = 0
        """How often the autopilot's clock jumped by more than that."""
        self.zero_us: int | None = None
        """The autopilot's time at the records' zero."""
        self._vehicle_id = vehicle_id
        self._newest_us = 0
        self._odd_us = self._odd_count = 0
        """The newest time that was not believed, and how many agreed about it."""
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
        return set(self._handlers)

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
        handler = self._handlers.get(name)
        if handler is None or any(getattr(message, number, 0) for number in SENSOR_NUMBERS):
            return []
        time_us = self._time(int(message.TimeUS))
        if time_us is None:
            return []
        waited = [] if name == "GPA" else self.flush()
        return [*waited, *handler(message, time_us)]

    def flush(self) -> list[Imported]:
        """Return the fix that waits for its accuracies, if one does."""
        fix, self._fix = self._fix, None
        return [] if fix is None else [fix]

    def _time(self, own_us: int) -> int | None:
        """Convert a message's time to the records' growing clock; None if damaged."""
        if self.zero_us is None:
            self.zero_us = own_us
        time_us = own_us - self.zero_us
        if not -LATE_US <= time_us - self._newest_us <= AHEAD_US:
            if not self._has_leaped(own_us):
                self.dropped += 1
                return None
            # The records' clock never goes back: a log that begins anew continues.
            self.zero_us += min(time_us - self._newest_us, 0)
            time_us = own_us - self.zero_us
        self._odd_count = 0
        self._newest_us = max(self._newest_us, time_us)
        return self._newest_us

    def _has_leaped(self, own_us: int) -> bool:
        """Return whether enough messages in a row have such an odd time."""
        agrees = abs(own_us - self._odd_us) <= LATE_US
        self._odd_us, self._odd_count = own_us, self._odd_count + 1 if agrees else 1
        has_leaped = self._odd_count == BELIEVED
        self.leaps += has_leaped
        return has_leaped

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
        if m.GWk and has_fix:
            utc_us = GPS_EPOCH_UNIX_US + m.GWk * WEEK_US + m.GMS * 1000 - LEAP_US
        self._fix = GpsFix(
            time_us=time_us,
            node=NodeId(self._vehicle_id, 1),
            node_time_us=time_us,
            itow_ms=m.GMS,
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
            return self.flush()
        north, east, down = fix.vel_n_mps
        self._fix = replace(
            fix,
            vel_n_mps=(north, east, down if getattr(m, "VV", 1) else NAN),
            h_acc_m=m.HAcc or NAN,
            v_acc_m=m.VAcc or NAN,
            speed_acc_mps=m.SAcc or NAN,
        )
        return self.flush()

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
