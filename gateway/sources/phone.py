"""Sensors of a phone, sent by one of three apps: Sensor Logger, phyphox or HyperIMU.

| app           | a line is                                                              | time    |
| ------------- | ---------------------------------------------------------------------- | ------- |
| Sensor Logger | a JSON object with `payload`, a list of readings [1]_                  | UTC, ns |
| phyphox       | the answer to `/get?...`, with the values of each `buffer` [2]_        | s       |
| HyperIMU      | numbers: the time, and three per sensor in the option `sensors`        | ms      |

Theory of operation. An app sends the readings of each sensor separately, several at a time. They
are sorted by time; each gyroscope reading becomes a sample, together with the newest accelerometer
reading and the newest magnetic field, if it was not used before. Repeated readings, and older ones
of the same sensor, are dropped.

The axes of a phone are x to the right of the screen, y to its top and z out of it. They are
converted to those of a board that is face up with its top to the nose. Specific force has Android's
sign, which Sensor Logger uses on iOS too with its setting "Standardise Units & Frames".

References
----------
.. [1] github.com/tszheichoi/awesome-sensor-logger: PUSHING.md, UNITS.md, COORDINATES.md.
.. [2] phyphox.org/wiki: Remote-interface communication.
"""

import json
import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final

from gateway.records import NAN, BaroRaw, BatteryReport, NodeId, Vec3, VehicleReport
from gateway.sources.lines import is_number
from gateway.sources.sampling import SampleClock, fix_at, imu_raw, velocity
from gateway.sources.settings import SourceUrl
from gateway.sources.source import SourceRecord, TextLines, unusable
from gateway.units import US_PER_S
from gateway.wire.framing import Fault
from gateway.wire.timesync import WRAP_MASK

MAX_LINE: Final = 1 << 20
"""Maximum size of a line, some seconds of all sensors."""
OLDEST_ACCEL_US: Final = 200_000
"""Maximum age of an accelerometer reading, to be combined with a gyroscope reading."""
RESTART_US: Final = 5 * US_PER_S
"""A time older than the newest by more than this means that the clock was set or restarted."""

UNREADABLE: Final = (
    ValueError,
    TypeError,
    LookupError,
    AttributeError,
    ArithmeticError,
    RecursionError,
)
"""Exceptions raised by content that does not have the form of an app."""

Reading = tuple[float, str, tuple[float, ...]]
"""Time of the phone in µs, quantity, and values; an absent value is NaN."""

POSITION: Final = ("lat", "lon", "alt", "speed", "course", "h_acc", "v_acc", "satellites")
"""Names of the values of the quantity `position`."""
XYZ: Final = ("x", "y", "z")
LOGGED: Final = {
    "totalacceleration": ("accel", XYZ),
    "accelerometer": ("motion", XYZ),
    "gravity": ("gravity", XYZ),
    "gyroscope": ("gyro", XYZ),
    "magnetometer": ("mag", XYZ),
    "barometer": ("pressure", ("pressure",)),
    "location": ("position", (
        "latitude", "longitude", "altitudeAboveMeanSeaLevel", "speed", "bearing",
        "horizontalAccuracy", "verticalAccuracy",
    )),
    "battery": ("battery", ("batteryLevel", "voltage")),
}  # fmt: skip
"""Quantity and keys of Sensor Logger's readings; its `accelerometer` excludes gravity."""
BUFFERS: Final = {
    "accel": ("acc_time", "accX", "accY", "accZ"),
    "gyro": ("gyr_time", "gyrX", "gyrY", "gyrZ"),
    "mag": ("mag_time", "magX", "magY", "magZ"),
    "pressure": ("pressure_time", "pressure"),
    "position": (
        "loc_time", "locLat", "locLon", "locZ", "locV", "locDir",
        "locAccuracy", "locZAccuracy", "locSatellites",
    ),
}  # fmt: skip
"""Buffers of phyphox's simple experiments; the first one contains the time."""
STREAMED: Final = {
    "accelerometer": "accel",
    "gyroscope": "gyro",
    "magnetometer": "mag",
    "gps": "position",
}
"""Quantities of HyperIMU's sensors; other sensors are skipped."""
USUAL_SENSORS: Final = "accelerometer,gyroscope,magnetometer,gps"


class PhoneDecoder(TextLines):
    """Decode the sensor readings of one phone."""

    def __init__(self, url: SourceUrl, node: NodeId) -> None:
        super().__init__(url.transport, MAX_LINE)
        self._node = node
        self._sensors = url.options.get("sensors", USUAL_SENSORS).lower().split(",")
        try:
            self._geoid_m = float(url.options.get("geoid_m", "0"))
        except ValueError as error:
            raise ValueError(f"source {url.name!r}: geoid_m must be a number") from error
        self._clock = SampleClock()
        self._newest_us: dict[str, float] = {}
        """Newest time by quantity."""
        self._values: dict[str, tuple[float, ...]] = {}
        """Newest values by quantity."""
        self._has_field = False
        """Whether the newest magnetic field has not been used in a sample yet."""
        self._polled_s: dict[str, str] = {}
        """Newest time by quantity, as phyphox wrote it."""

    def request(self) -> str:
        """Return path and query of a phyphox request for all values newer than its last answer."""
        found = []
        for quantity, (time, *values) in BUFFERS.items():
            since = self._polled_s.get(quantity, "")
            # Without a time, the answer would contain only the newest value.
            found.append(f"{time}={since}")
            found += [f"{name}={since}|{time}" if since else f"{name}=" for name in values]
        return "/get?" + "&".join(found)

    def line(self, line: str, arrival_us: int) -> list[SourceRecord | Fault]:
        """Return the records and faults in a line of any of the apps."""
        try:
            return self._records(self._readings(line), arrival_us)
        except UNREADABLE as error:
            why = str(error) if isinstance(error, ValueError) else "is not from a known app"
            return [unusable("phone", line, why)]

    def _readings(self, line: str) -> list[Reading]:
        """Read a line of any of the apps; raises an exception of `UNREADABLE`."""
        if not line.startswith("{"):
            return [*self._of_hyperimu(line)]
        content = json.loads(line)
        if "payload" in content:
            return [reading for entry in content["payload"] for reading in _of_sensor_logger(entry)]
        return self._of_phyphox(content["buffer"], content["status"])

    def _of_phyphox(self, buffers: Mapping[str, Any], status: Mapping[str, Any]) -> list[Reading]:
        found: list[Reading] = []
        for quantity, names in BUFFERS.items():
            if names[0] not in buffers:
                continue
            columns = [buffers.get(name, {}).get("buffer", []) for name in names]
            rows = [*zip(*columns, strict=False)]
            # The newest is last; its time is sent back as phyphox wrote it.
            rows = [row for row in rows if is_number(row[0])]
            if rows:
                self._polled_s[quantity] = repr(float(rows[-1][0]))
            found += [(row[0] * US_PER_S, quantity, _numbers(row[1:])) for row in rows]
        if not found:
            # phyphox was restarted, so its times begin at zero again.
            self._polled_s.clear()
            if not status.get("measuring"):
                raise ValueError("the measurement is not running: start it in the app")
        return found

    def _of_hyperimu(self, line: str) -> Iterator[Reading]:
        time_ms, *values = (float(cell) for cell in line.rstrip(",").split(","))
        if len(values) != 3 * len(self._sensors):
            raise ValueError(
                f"has {len(values)} values, and not three of each of {', '.join(self._sensors)}; "
                "name those of the app by ?sensors="
            )
        for k, sensor in enumerate(self._sensors):
            quantity = STREAMED.get(sensor)
            reading = tuple(values[3 * k : 3 * k + 3])
            # Each line repeats the newest magnetic field and position.
            if quantity in ("mag", "position") and self._values.get(quantity) == reading:
                continue
            if quantity is not None and (quantity != "position" or any(reading)):
                yield time_ms * 1000.0, quantity, reading

    def _records(self, readings: list[Reading], arrival_us: int) -> list[SourceRecord | Fault]:
        found: list[SourceRecord | Fault] = []
        if not readings:
            return found
        # At the same time, other quantities come before the gyroscope, as they complete its sample.
        readings.sort(key=lambda reading: (reading[0], reading[1] == "gyro"))
        last_us, late = readings[-1][0], 0
        if not 0.0 <= last_us < 1e17:
            raise ValueError("has an invalid time")
        # The newest reading has the least delay; the ages of others are those on the phone's clock.
        local_us = self._clock.local(round(last_us), arrival_us)
        if last_us < max(self._newest_us.values(), default=0.0) - RESTART_US:
            self._newest_us.clear()
        for stamp_us, quantity, values in readings:
            newest_us = self._newest_us.get(quantity, last_us - RESTART_US)
            if not stamp_us > newest_us:
                late += stamp_us < newest_us
                continue
            self._newest_us[quantity], self._values[quantity] = stamp_us, values
            self._has_field |= quantity == "mag"
            record = self._record(stamp_us, quantity, local_us - round(last_us - stamp_us))
            found += [] if record is None else [record]
        if late:
            found.append(Fault("late", late, f"{late} readings arrived after newer ones"))
        return found

    def _record(self, stamp_us: float, quantity: str, local_us: int) -> SourceRecord | None:
        """Return the record that a reading completes, if any."""
        if quantity in ("accel", "motion", "gravity", "mag"):
            return None
        values, node = self._values[quantity], self._node
        time_us = self._clock.after_last(local_us)
        match quantity:
            case "gyro":
                return self._sample(stamp_us, time_us)
            case "pressure":
                stamp, pascals = time_us & WRAP_MASK, values[0] * 100.0
                return None if pascals != pascals else BaroRaw(time_us, node, stamp, pascals, NAN)
            case "position":
                return self._fix(time_us, values)
        level, volts = values
        percent = level * 100.0 if level >= 0.0 else NAN
        battery = BatteryReport(voltage_v=volts, remaining_percent=percent)
        return VehicleReport(time_us=time_us, node=node, battery=battery)

    def _sample(self, stamp_us: float, time_us: int) -> SourceRecord | None:
        accel = self._values.get("accel")
        since_us = self._newest_us.get("accel", -math.inf)
        motion, gravity = self._values.get("motion"), self._values.get("gravity")
        if accel is None and motion is not None and gravity is not None:
            accel = tuple(a + g for a, g in zip(motion, gravity, strict=True))
            since_us = min(self._newest_us.get(name, -math.inf) for name in ("motion", "gravity"))
        if accel is None or stamp_us - since_us > OLDEST_ACCEL_US:
            return None
        field = _board(self._values["mag"]) if self._has_field else None
        self._has_field = False
        rates = tuple(math.degrees(rate) for rate in self._values["gyro"])
        return imu_raw(time_us, self._node, _board(accel), _board(rates), field)

    def _fix(self, time_us: int, values: tuple[float, ...]) -> SourceRecord | None:
        known = dict(zip(POSITION, values, strict=False))
        # The apps encode invalid values as negative numbers.
        speed, course, h_acc, v_acc, satellites = (
            value if (value := known.get(name, NAN)) >= 0.0 else NAN for name in POSITION[3:]
        )
        return fix_at(
            time_us,
            self._node,
            known["lat"],
            known["lon"],
            known["alt"] - self._geoid_m,
            vel_n_mps=velocity(speed, course),
            satellites=round(satellites) if satellites == satellites else 0,
            h_acc_m=h_acc,
            v_acc_m=v_acc,
        )


def _of_sensor_logger(entry: Mapping[str, Any]) -> Iterator[Reading]:
    quantity, keys = LOGGED.get(entry["name"], ("", ()))
    if quantity:
        values = dict(entry["values"])
        # On Android before version 14, only the height above the ellipsoid is available.
        values.setdefault("altitudeAboveMeanSeaLevel", values.get("altitude"))
        yield entry["time"] / 1000.0, quantity, _numbers(values.get(key) for key in keys)


def _numbers(values: Iterable[object]) -> tuple[float, ...]:
    """Return the values as numbers, with NaN for anything else."""
    return tuple(float(v) if is_number(v) else NAN for v in values)  # type: ignore[arg-type]


def _board(values: tuple[float, ...]) -> Vec3:
    """Convert the axes of a phone to those of a board: x forward, y left, z up."""
    x, y, z = values
    return (y, -x, z)
