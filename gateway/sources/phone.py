"""A phone's sensors, as three apps send them: Sensor Logger, phyphox and HyperIMU.

| app           | a line is                                                              | time    |
| ------------- | ---------------------------------------------------------------------- | ------- |
| Sensor Logger | a JSON object with `payload`, a list of readings [1]_                  | UTC, ns |
| phyphox       | its answer to `/get?...`, with the values of each `buffer` [2]_        | s       |
| HyperIMU      | numbers: the time, and three of each sensor of the option `sensors`    | ms      |

Theory of operation. An app sends each sensor's readings by themselves, and several at once. They
are put into the order of their times; each reading of the gyroscope becomes a sample, with the
newest accelerometer and the newest field that no sample has had. Readings that come again, or older
ones of the same sensor, are dropped.

A phone's axes are x to the right of the screen, y to its top and z out of it; it becomes a board
that lies face up with its top to the nose. Specific force is that of Android, also in Sensor
Logger on iOS with its setting "Standardise Units & Frames".

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
from gateway.sources.lines import LineSplitter, is_number
from gateway.sources.sampling import SampleClock, fix_at, imu_raw, velocity
from gateway.sources.settings import SourceUrl
from gateway.sources.source import SourceRecord, unusable
from gateway.units import US_PER_S
from gateway.wire.framing import Fault
from gateway.wire.timesync import WRAP_MASK

MAX_LINE: Final = 1 << 20
"""Some seconds of all sensors."""
OLDEST_ACCEL_US: Final = 200_000
"""Before a reading of the gyroscope, with which it is fused."""
RESTART_US: Final = 5 * US_PER_S
"""A time that is so much older than the newest is that of a clock which was set or restarted."""

UNREADABLE: Final = (
    ValueError,
    TypeError,
    LookupError,
    AttributeError,
    ArithmeticError,
    RecursionError,
)
"""Raised by content in another form than that of the apps."""

Reading = tuple[float, str, tuple[float, ...]]
"""Time of the phone, µs, a quantity, and its values; an absent one is NaN."""

POSITION: Final = ("lat", "lon", "alt", "speed", "course", "h_acc", "v_acc", "satellites")
"""The values of the quantity `position`."""
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
"""Quantity and keys of Sensor Logger's readings; its accelerometer has no gravity."""
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
"""Buffers of phyphox's simple experiments, that with the time first."""
STREAMED: Final = {
    "accelerometer": "accel",
    "gyroscope": "gyro",
    "magnetometer": "mag",
    "gps": "position",
}
"""Sensors of HyperIMU; others are skipped."""
USUAL_SENSORS: Final = "accelerometer,gyroscope,magnetometer,gps"


class PhoneDecoder:
    """Decode the readings of one phone."""

    def __init__(self, url: SourceUrl, node: NodeId) -> None:
        self._node = node
        self._splitter = LineSplitter(url.transport, MAX_LINE)
        self._sensors = url.options.get("sensors", USUAL_SENSORS).lower().split(",")
        try:
            self._geoid_m = float(url.options.get("geoid_m", "0"))
        except ValueError as error:
            raise ValueError(f"source {url.name!r}: geoid_m must be a number") from error
        self._clock = SampleClock()
        self._newest_us: dict[str, float] = {}
        """The newest time of each quantity."""
        self._values: dict[str, tuple[float, ...]] = {}
        """The newest values of each quantity."""
        self._has_field = False
        """Whether no sample has had the newest field yet."""
        self._polled_s: dict[str, str] = {}
        """The newest time of each quantity as phyphox wrote it."""

    def reset(self) -> None:
        """Discard a line that has not ended."""
        self._splitter.reset()

    def request(self) -> str:
        """Return the path and query of phyphox for all that is newer than its last answer."""
        found = []
        for quantity, (time, *values) in BUFFERS.items():
            since = self._polled_s.get(quantity, "")
            # Without a time, an answer has the newest value only.
            found.append(f"{time}={since}")
            found += [f"{name}={since}|{time}" if since else f"{name}=" for name in values]
        return "/get?" + "&".join(found)

    def feed(self, data: bytes, arrival_us: int) -> list[SourceRecord | Fault]:
        """Decode every line that a chunk completes."""
        found: list[SourceRecord | Fault] = []
        for line in self._splitter.feed(data):
            if isinstance(line, Fault):
                found.append(line)
            elif line:
                try:
                    found += self._records(self._readings(line), arrival_us)
                except UNREADABLE as error:
                    why = str(error) if isinstance(error, ValueError) else "is of no known app"
                    found.append(unusable("phone", line, why))
        return found

    def _readings(self, line: str) -> list[Reading]:
        """Read a line of any app; raises one of `UNREADABLE`."""
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
            # Newest last; the number is sent back as it was written.
            rows = [row for row in rows if is_number(row[0])]
            if rows:
                self._polled_s[quantity] = repr(float(rows[-1][0]))
            found += [(row[0] * US_PER_S, quantity, _numbers(row[1:])) for row in rows]
        if not found:
            # After a restart its times begin at zero again.
            self._polled_s.clear()
            if not status.get("measuring"):
                raise ValueError("the measurement does not run: start it in the app")
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
            # Each line repeats the newest field and position.
            if quantity in ("mag", "position") and self._values.get(quantity) == reading:
                continue
            if quantity is not None and (quantity != "position" or any(reading)):
                yield time_ms * 1000.0, quantity, reading

    def _records(self, readings: list[Reading], arrival_us: int) -> list[SourceRecord | Fault]:
        found: list[SourceRecord | Fault] = []
        if not readings:
            return found
        # Other quantities of a sample come before the gyroscope of the same time.
        readings.sort(key=lambda reading: (reading[0], reading[1] == "gyro"))
        last_us, late = readings[-1][0], 0
        if not 0.0 <= last_us < 1e17:
            raise ValueError("has an invalid time")
        # The newest has waited least; the others are as much older as on the phone's clock.
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
            found.append(Fault("late", late, f"{late} readings came after newer ones"))
        return found

    def _record(self, stamp_us: float, quantity: str, local_us: int) -> SourceRecord | None:
        """Make the record that a reading completes."""
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
        # The apps write invalid values as negative ones.
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
        # Before version 14 Android has only the height above the ellipsoid.
        values.setdefault("altitudeAboveMeanSeaLevel", values.get("altitude"))
        yield entry["time"] / 1000.0, quantity, _numbers(values.get(key) for key in keys)


def _numbers(values: Iterable[object]) -> tuple[float, ...]:
    """Return numbers, NaN in place of anything else."""
    return tuple(float(v) if is_number(v) else NAN for v in values)  # type: ignore[arg-type]


def _board(values: tuple[float, ...]) -> Vec3:
    """Turn a phone's axes into those of a board: x forward, y left, z up."""
    x, y, z = values
    return (y, -x, z)
