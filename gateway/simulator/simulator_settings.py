"""Settings of the simulated tracker."""

from typing import Annotated

import msgspec

from gateway.settings import Settings, setting

_Seconds = Annotated[float, msgspec.Meta(ge=0, le=1e6)]
GpsOutages = tuple[tuple[_Seconds, _Seconds], ...]


class SimulatorSettings(Settings, frozen=True):
    """The simulated aircraft, its sensors, its radio and the receiver."""

    seed: Annotated[
        int,
        setting(
            "Seed of all random numbers; the same seed gives the same flight.", ge=0, le=2**32 - 1
        ),
    ] = 1
    vehicle_id: Annotated[
        int, setting("Vehicle id in the frames of the first aircraft.", ge=1, le=31)
    ] = 1
    vehicles: Annotated[
        int,
        setting("Number of aircraft; they have consecutive ids.", ge=1, le=6),
    ] = 1
    home_lat_deg: Annotated[
        float, setting("Latitude of the runway's threshold.", "deg", ge=-80, le=80)
    ] = -7.7656
    home_lon_deg: Annotated[
        float, setting("Longitude of the runway's threshold.", "deg", ge=-180, le=180)
    ] = 110.3728
    home_alt_m: Annotated[
        float, setting("Height of the runway above mean sea level.", "m", ge=-400, le=4000)
    ] = 110.0
    geoid_separation_m: Annotated[
        float, setting("Height of the geoid above the ellipsoid.", "m", ge=-110, le=90)
    ] = 23.0
    wind_mps: Annotated[float, setting("Mean wind speed aloft.", "m/s", ge=0, le=5)] = 4.0
    wind_from_deg: Annotated[
        float,
        setting("True direction the wind blows from; the runway follows it.", "deg", ge=0, le=360),
    ] = 110.0
    gust_mps: Annotated[
        float, setting("Standard deviation of the gusts on each axis.", "m/s", ge=0, le=2)
    ] = 0.5
    vibration_mps2: Annotated[
        float,
        setting("Standard deviation of the motor's vibration at full power.", "m/s2", ge=0, le=30),
    ] = 0.5
    imu_rate_hz: Annotated[int, setting("IMU payloads per second.", "Hz", ge=10, le=1000)] = 100
    baro_rate_hz: Annotated[int, setting("Barometer payloads per second.", "Hz", ge=1, le=50)] = 25
    gps_latency_s: Annotated[
        float,
        setting("Mean time from a fix's validity to its arrival at the node.", "s", ge=0.02, le=1),
    ] = 0.16
    gps_latency_jitter_s: Annotated[
        float, setting("Greatest deviation from the mean latency.", "s", ge=0, le=0.08)
    ] = 0.03
    gps_first_fix_s: Annotated[
        float, setting("Time from the start to the first fix.", "s", ge=0, le=600)
    ] = 5.0
    gps_outages_s: Annotated[
        GpsOutages,
        setting("Start and length of each loss of the fix, from the start of a flight.", "s"),
    ] = ((100.0, 10.0), (160.0, 3.0))
    clock_skew_ppm: Annotated[
        float,
        setting(
            "How much faster than true time the IMU node's clock runs; the GPS node's runs slower "
            "by as much, the receiver's faster by half.",
            "ppm",
            ge=-2000,
            le=2000,
        ),
    ] = 120.0
    imu_restart_s: Annotated[
        float,
        setting(
            "Time at which the IMU node restarts; 0 for never.",
            "s",
            ge=0,
            le=1e6,
        ),
    ] = 0.0
    radio_loss: Annotated[float, setting("Share of payloads that are lost.", ge=0, le=0.9)] = 0.01
    radio_burst: Annotated[
        float, setting("Mean number of payloads that are lost in a row.", ge=1, le=500)
    ] = 1.0
    radio_duplicates: Annotated[
        float, setting("Share of payloads that are duplicated.", ge=0, le=0.5)
    ] = 0.001
    baud: Annotated[
        int, setting("Speed of the receiver's serial line.", "baud", ge=9600, le=2e6)
    ] = 500_000
    corrupt_bytes: Annotated[
        float, setting("Share of the bytes on the serial line that are damaged.", ge=0, le=1)
    ] = 0.0
