"""Names of the chips and modules that a node reports by what they call themselves."""

from dataclasses import dataclass
from typing import Final

GPS_ACKNOWLEDGES: Final = 0x10
"""Bit of the GPS byte: the receiver acknowledges its settings."""
GPS_NMEA: Final = 1
SENSOR_IMU, SENSOR_MAG, SENSOR_BARO, SENSOR_GPS = (1 << bit for bit in range(4))
"""Bits of a node's sensors present and failed."""

_IMU: Final = {
    0x68: "MPU6050",
    0x70: "MPU6500",
    0x71: "MPU9250",
    0x73: "MPU9255",
    0x74: "MPU6515",
    0x98: "ICM-20689",
    0x12: "ICM-20602",
    0x19: "MPU6886",
    0xAF: "ICM-20608",
}
"""By WHO_AM_I."""
_MAG: Final = {0x1E: "HMC5883L", 0x0D: "QMC5883L", 0x2C: "QMC5883P"}
"""By I2C address; HMC5983 and DA5883 have the identification of the HMC5883L."""
_BARO: Final = {0x55: "BMP180", 0x56: "BMP280", 0x57: "BMP280", 0x58: "BMP280", 0x60: "BME280"}
"""By chip id."""
_GPS: Final = {
    GPS_NMEA: "NMEA receiver",
    2: "u-blox look-alike",
    6: "u-blox 6",
    7: "u-blox 7",
    8: "u-blox M8",
    9: "u-blox 9",
    10: "u-blox M10",
}


@dataclass(frozen=True, slots=True)
class Chips:
    """What a node has found, as it sends it; 0 where there is nothing."""

    imu: int = 0
    """WHO_AM_I."""
    magnetometer: int = 0
    """I2C address."""
    barometer: int = 0
    """Chip id."""
    gps: int = 0
    """Kind of receiver, and `GPS_ACKNOWLEDGES`."""
    gps_baud_hundreds: int = 0


def chip_names(chips: Chips, sensors_present: int) -> tuple[str, ...]:
    """Name the chips that a node has seen since its start.

    Parameters
    ----------
    chips : Chips
    sensors_present : int
        The node's bits: an identification of 0 is one, too, if the sensor is there.

    Returns
    -------
    tuple of str
        One text for each sensor, such as `"QMC5883L"` or `"u-blox M10 at 57600 baud"`.
    """
    names = []
    if sensors_present & SENSOR_IMU:
        names.append(_IMU.get(chips.imu, f"MPU6050 look-alike, id 0x{chips.imu:02X}"))
    if sensors_present & SENSOR_MAG:
        names.append(_MAG.get(chips.magnetometer, f"compass at 0x{chips.magnetometer:02X}"))
    if sensors_present & SENSOR_BARO:
        names.append(_BARO.get(chips.barometer, f"barometer, id 0x{chips.barometer:02X}"))
    if sensors_present & SENSOR_GPS and chips.gps:
        names.append(_gps_name(chips))
    return tuple(names)


def _gps_name(chips: Chips) -> str:
    kind = chips.gps & 0x0F
    name = f"{_GPS.get(kind, 'u-blox')} at {100 * chips.gps_baud_hundreds} baud"
    unheard = kind != GPS_NMEA and not chips.gps & GPS_ACKNOWLEDGES
    return f"{name}, acknowledges nothing" if unheard else name
