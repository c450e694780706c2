"""A short simulated flight as calibrated records, and other programs' logs of it."""

import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from gateway.geometry.quaternion import to_euler
from gateway.records import BaroRaw, GpsFix, ImuCalibrated
from gateway.sensing.calibration import NodeCalibration
from gateway.sensing.chain import SensorChain
from gateway.simulator.simulator_settings import SimulatorSettings
from tools.simulated_flight import SimulatedFlight, fly

DURATION_S = 75.0
"""Rest, take-off and the first turns."""
BOOT_US = 5_000_000
"""Time of the autopilot's clock at the first sample."""
LEAP_S, GPS_EPOCH_S, WEEK_S = 18, 315_964_800, 604_800

Record = ImuCalibrated | BaroRaw | GpsFix


@cache
def simulated() -> SimulatedFlight:
    settings = SimulatorSettings(imu_rate_hz=50, gps_outages_s=())
    return fly(settings, duration_s=DURATION_S)


@cache
def records() -> tuple[Record, ...]:
    """Calibrate the samples as the sensors' drivers of an autopilot do."""
    flight = simulated()
    chain = SensorChain(NodeCalibration(**flight.errors))
    found: list[Record] = []
    for record in flight.records():
        if isinstance(record, BaroRaw | GpsFix):
            found.append(record)
            continue
        s = chain.imu(record)
        values = (s.accel_b_mps2, s.gyro_b_radps, s.mag_b_ut, 20.0, s.flags)
        found.append(ImuCalibrated(s.time_us, record.node, *values))
    return tuple(found)


@dataclass(frozen=True)
class Estimated:
    """The estimate of the autopilot: the truth, ten times a second."""

    time_us: int
    q_nb: tuple[float, ...]
    lat_deg: float
    lon_deg: float
    alt_m: float
    vel_n_mps: tuple[float, ...]


@cache
def estimated() -> tuple[Estimated, ...]:
    time_s = np.arange(0.1, DURATION_S, 0.1)
    truth = simulated().trajectory.truth_at(time_s)
    columns = (truth.q_nb, truth.lat_deg, truth.lon_deg, truth.alt_amsl_m, truth.vel_n_mps)
    rows = zip(*(column.tolist() for column in columns), strict=True)
    return tuple(
        Estimated(round(t * 1e6), tuple(q), lat, lon, alt, tuple(vel))
        for t, (q, lat, lon, alt, vel) in zip(time_s.tolist(), rows, strict=True)
    )


def timed(
    *streams: Iterable[Record | Estimated], seconds: float = DURATION_S
) -> list[Record | Estimated]:
    found = (r for stream in streams for r in stream if r.time_us <= seconds * 1e6)
    return sorted(found, key=lambda r: r.time_us)


# ULog: https://docs.px4.io/main/en/dev_log/ulog_file_format

NEW_GPS = (
    "uint64_t timestamp;uint64_t time_utc_usec;double latitude_deg;double longitude_deg;"
    "double altitude_msl_m;double altitude_ellipsoid_m;float s_variance_m_s;float c_variance_rad;"
    "float eph;float epv;float hdop;float vdop;float vel_m_s;float vel_n_m_s;float vel_e_m_s;"
    "float vel_d_m_s;int32_t timestamp_time_relative;uint8_t fix_type;bool vel_ned_valid;"
    "uint8_t satellites_used;uint8_t[5] _padding0;"
)
OLD_GPS = NEW_GPS.replace(
    "double latitude_deg;double longitude_deg;double altitude_msl_m;double altitude_ellipsoid_m;",
    "int32_t lat;int32_t lon;int32_t alt;int32_t alt_ellipsoid;",
)
FORMATS = {
    "sensor_combined": "uint64_t timestamp;float[3] gyro_rad;uint32_t gyro_integral_dt;"
    "int32_t accelerometer_timestamp_relative;float[3] accelerometer_m_s2;"
    "uint32_t accelerometer_integral_dt;",
    "vehicle_magnetometer": "uint64_t timestamp;float[3] magnetometer_ga;",
    "vehicle_air_data": "uint64_t timestamp;float baro_pressure_pa;float baro_temp_celcius;",
    "sensor_baro": "uint64_t timestamp;float pressure;float temperature;",
    "vehicle_gps_position": NEW_GPS,
    "vehicle_attitude": "uint64_t timestamp;float[4] q;",
    "vehicle_global_position": "uint64_t timestamp;double lat;double lon;float alt;float eph;",
    "vehicle_local_position": "uint64_t timestamp;float vx;float vy;float vz;",
}
STRUCTS = {
    "uint64_t": "Q", "uint32_t": "I", "int32_t": "i", "uint8_t": "B", "bool": "?", "float": "f",
    "double": "d",
}  # fmt: skip
SYNC = bytes.fromhex("2f731320250cbb12")


def ulog_message(kind: bytes, payload: bytes) -> bytes:
    return struct.pack("<Hc", len(payload), kind) + payload


def ulog_parameter(name: str, value: int) -> bytes:
    key = f"int32_t {name}".encode()
    return bytes([len(key)]) + key + struct.pack("<i", value)


class Ulog:
    """Writes topics as PX4's logger does."""

    def __init__(self, formats: dict[str, str], parameters: dict[str, int]) -> None:
        self.parts = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", BOOT_US)]
        self.parts.append(ulog_message(b"B", bytes(40)))
        self.ids = {name: number for number, name in enumerate(formats)}
        self.structs = {}
        for name, fields in formats.items():
            self.parts.append(ulog_message(b"F", f"{name}:{fields}".encode()))
            form = "<"
            for field in fields.removesuffix("uint8_t[5] _padding0;").rstrip(";").split(";"):
                kind, _, count = field.split(" ")[0].partition("[")
                form += (count.rstrip("]") or "1") + STRUCTS[kind]
            self.structs[name] = struct.Struct(form)
        for name, value in parameters.items():
            self.parts.append(ulog_message(b"P", ulog_parameter(name, value)))
        for name, number in self.ids.items():
            self.parts.append(ulog_message(b"A", struct.pack("<BH", 0, number) + name.encode()))

    def add(self, topic: str, time_us: int, *values: float) -> None:
        data = self.structs[topic].pack(BOOT_US + time_us, *values)
        self.parts.append(ulog_message(b"D", struct.pack("<H", self.ids[topic]) + data))


def make_ulog(*, old: bool = False, seconds: float = DURATION_S) -> bytes:
    """Write the flight as PX4 of today, or of 2018: positions as integers, pressures in hPa."""
    formats = dict(FORMATS)
    formats["vehicle_gps_position"] = OLD_GPS if old else NEW_GPS
    formats.pop("vehicle_air_data" if old else "sensor_baro")
    log = Ulog(formats, {"MAV_SYS_ID": 7})
    for r in timed(records(), estimated(), seconds=seconds):
        t = r.time_us
        if isinstance(r, Estimated) and t % 500_000 == 0:
            log.parts.append(ulog_message(b"S", SYNC))
        match r:
            case ImuCalibrated():
                log.add("sensor_combined", t, *r.gyro_b_radps, 20_000, 0, *r.accel_b_mps2, 20_000)
                if r.mag_b_ut:
                    log.add("vehicle_magnetometer", t, *(value / 100 for value in r.mag_b_ut))
            case BaroRaw():
                if old:
                    log.add("sensor_baro", t, r.pressure_pa / 100, r.temperature_degc)
                else:
                    log.add("vehicle_air_data", t, r.pressure_pa, r.temperature_degc)
            case GpsFix():
                position = (r.lat_dege7 * 1e-7, r.lon_dege7 * 1e-7, r.alt_amsl_m, r.alt_ellipsoid_m)
                if old:
                    mm = (round(r.alt_amsl_m * 1e3), round(r.alt_ellipsoid_m * 1e3))
                    position = (r.lat_dege7, r.lon_dege7, *mm)
                vel = (float(np.hypot(*r.vel_n_mps[:2])), *r.vel_n_mps)
                acc = (r.speed_acc_mps, np.radians(r.course_acc_deg), r.h_acc_m, r.v_acc_m)
                values = (*position, *acc, 0.8, 1.1, *vel, 0, int(r.fix_type), r.fix_ok)
                log.add("vehicle_gps_position", t, r.utc_us or 0, *values, r.satellites)
            case Estimated():
                log.add("vehicle_local_position", t, *r.vel_n_mps)
                log.add("vehicle_global_position", t, r.lat_deg, r.lon_deg, r.alt_m, 1.0)
                log.add("vehicle_attitude", t, *r.q_nb)
    return b"".join(log.parts)


# DataFlash: libraries/AP_Logger of ArduPilot, its formats of 4.5

DATAFLASH = {
    "FMT": (128, "BBnNZ", "Type,Length,Name,Format,Columns"),
    "PARM": (129, "QNff", "TimeUS,Name,Value,Default"),
    "IMU": (130, "QBffffffIIfBBHH", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz"),
    "MAG": (131, "QBhhhhhhhhhBI", "TimeUS,I,MagX,MagY,MagZ,OfsX,OfsY,OfsZ,MOX,MOY,MOZ,Health,S"),
    "BARO": (132, "QBfffcfIffB", "TimeUS,I,Alt,AltAMSL,Press,Temp,CRt,SMS,Offset,GndTemp,H"),
    "GPS": (133, "QBBIHBcLLeffffB",
            "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U"),
    "GPA": (134, "QBCCCCfBIH", "TimeUS,I,VDop,HAcc,VAcc,SAcc,YAcc,VV,SMS,Delta"),
    "ATT": (135, "QccccCCCCB", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw,ErrRP,ErrYaw,AEKF"),
    "POS": (136, "QLLfff", "TimeUS,Lat,Lng,Alt,RelHomeAlt,RelOriginAlt"),
    "XKF1": (137, "QBccCfff", "TimeUS,C,Roll,Pitch,Yaw,VN,VE,VD"),
}  # fmt: skip
Format = tuple[int, str, str]
CODES = {
    "B": "B", "M": "B", "b": "b", "n": "4s", "N": "16s", "Z": "64s", "Q": "Q", "f": "f",
    "d": "d", "I": "I", "H": "H", "h": "h", "c": "h", "C": "H", "e": "i", "L": "i",
}  # fmt: skip
SCALES = {"c": 100, "C": 100, "e": 100, "L": 1e7}

Row = tuple[str, Sequence[float | bytes]]


def dataflash_rows(seconds: float = DURATION_S) -> list[Row]:
    rows: list[Row] = [("PARM", (BOOT_US, b"SYSID_THISMAV", 9.0, 1.0))]
    for r in timed(records(), estimated(), seconds=seconds):
        t = BOOT_US + r.time_us
        match r:
            case ImuCalibrated():
                if r.mag_b_ut:
                    mag = [round(value * 10) for value in r.mag_b_ut]
                    rows.append(("MAG", (t, 0, *mag, *[0] * 6, 1, 0)))
                inertial = (*r.gyro_b_radps, *r.accel_b_mps2)
                rows.append(("IMU", (t, 0, *inertial, 0, 0, 20.0, 1, 1, 400, 400)))
                # Another sensor's, which must stay out.
                rows.append(("IMU", (t, 1, *[99.0] * 6, 0, 0, 20.0, 1, 1, 400, 400)))
            case BaroRaw():
                air = (0.0, 0.0, r.pressure_pa, r.temperature_degc)
                rows.append(("BARO", (t, 0, *air, 0.0, 0, 0.0, 20.0, 1)))
            case GpsFix():
                week, ms = 0, 0
                if r.utc_us:
                    since_ms = r.utc_us // 1000 + (LEAP_S - GPS_EPOCH_S) * 1000
                    week, ms = divmod(since_ms, WEEK_S * 1000)
                north, east, down = r.vel_n_mps
                course = float(np.degrees(np.arctan2(east, north)) % 360)
                position = (r.lat_dege7 / 1e7, r.lon_dege7 / 1e7, r.alt_amsl_m)
                motion = (float(np.hypot(north, east)), course, down, 0.0)
                status = 3 if r.fix_ok else 1
                time = (status, ms, week, r.satellites, 0.8)
                rows.append(("GPS", (t, 0, *time, *position, *motion, 1)))
                acc = (r.h_acc_m, r.v_acc_m, r.speed_acc_mps)
                rows.append(("GPA", (t, 0, 1.1, *acc, 0.0, 1, 0, 200)))
            case Estimated():
                roll, pitch, yaw = np.degrees(to_euler(r.q_nb))
                rows.append(("POS", (t, r.lat_deg, r.lon_deg, r.alt_m, 0.0, 0.0)))
                rows.append(("XKF1", (t, 0, roll, pitch, yaw % 360, *r.vel_n_mps)))
                rows.append(("ATT", (t, 0, roll, 0, pitch, 0, yaw % 360, 0, 0, 3)))
    return rows


def dataflash_size(form: str) -> int:
    return 3 + struct.calcsize("<" + "".join(CODES[letter] for letter in form))


def dataflash_heads(formats: dict[str, Format]) -> list[Row]:
    return [
        ("FMT", (number, dataflash_size(form), name.encode(), form.encode(), columns.encode()))
        for name, (number, form, columns) in formats.items()
    ]


def make_dataflash(seconds: float = DURATION_S) -> bytes:
    return dataflash_of(DATAFLASH, dataflash_rows(seconds))


def packed(
    name: str, values: Sequence[float | bytes], formats: dict[str, Format] = DATAFLASH
) -> bytes:
    number, form, _ = formats[name]
    scaled = [
        round(value * SCALES[letter])
        if letter in SCALES and not isinstance(value, bytes)
        else value
        for letter, value in zip(form, values, strict=True)
    ]
    codes = "".join(CODES[letter] for letter in form)
    return b"\xa3\x95" + struct.pack("<B" + codes, number, *scaled)


def dataflash_of(formats: dict[str, Format], rows: Sequence[Row]) -> bytes:
    """Write messages of any formats; each row is a name and its values in the format's units."""
    known = {"FMT": DATAFLASH["FMT"]} | formats
    heads = dataflash_heads(known)
    return b"".join(packed(name, values, known) for name, values in [*heads, *rows])


def make_dataflash_text(seconds: float = DURATION_S) -> bytes:
    """As `.log` files have it: a line a message, its values in the units of the columns."""
    lines = []
    for name, values in [*dataflash_heads(DATAFLASH), *dataflash_rows(seconds)]:
        texts = (v.decode() if isinstance(v, bytes) else repr(float(v)) if isinstance(v, float)
                 or v != int(v) else str(int(v)) for v in values)  # fmt: skip
        lines.append(", ".join([name, *texts]))
    return ("\n".join(lines) + "\n").encode()


def write(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path
