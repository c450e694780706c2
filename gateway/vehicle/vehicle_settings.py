"""Settings of the vehicle that ground stations see."""

from typing import Annotated, Literal

import msgspec

from gateway.settings import Settings, setting

VehicleType = Literal[
    "generic", "fixed_wing", "quadrotor", "hexarotor", "octorotor", "tricopter", "helicopter",
    "airship", "free_balloon", "rocket", "ground_rover", "surface_boat", "submarine",
    "flapping_wing", "kite", "vtol_tiltrotor", "parafoil",
]  # fmt: skip
"""The MAV_TYPE names that every ground station shows as a vehicle."""

Autopilot = Literal["generic", "ardupilotmega", "px4"]
"""The MAV_AUTOPILOT names that programs require."""

OperatorControl = Literal["open", "exclusive"]

ArmedWhen = Literal["flying", "recording", "flying_or_recording", "always", "never"]


def _rate(message: str) -> msgspec.Meta:
    return setting(f"{message} per second; 0 sends none.", "Hz", ge=0.0, le=1000.0)


class RateSettings(Settings, frozen=True):
    """Rate of each message, at most that of its sensor."""

    attitude_quaternion_hz: Annotated[float, _rate("ATTITUDE_QUATERNION")] = 50.0
    attitude_hz: Annotated[float, _rate("ATTITUDE")] = 50.0
    global_position_int_hz: Annotated[float, _rate("GLOBAL_POSITION_INT")] = 10.0
    vfr_hud_hz: Annotated[float, _rate("VFR_HUD")] = 10.0
    highres_imu_hz: Annotated[float, _rate("HIGHRES_IMU")] = 10.0
    gps_raw_int_hz: Annotated[float, _rate("GPS_RAW_INT")] = 5.0
    scaled_pressure_hz: Annotated[float, _rate("SCALED_PRESSURE")] = 5.0
    nav_controller_output_hz: Annotated[float, _rate("NAV_CONTROLLER_OUTPUT")] = 2.0
    sys_status_hz: Annotated[float, _rate("SYS_STATUS")] = 2.0
    estimator_status_hz: Annotated[float, _rate("ESTIMATOR_STATUS")] = 1.0
    extended_sys_state_hz: Annotated[float, _rate("EXTENDED_SYS_STATE")] = 2.0
    system_time_hz: Annotated[float, _rate("SYSTEM_TIME")] = 1.0
    home_position_hz: Annotated[float, _rate("HOME_POSITION")] = 1.0
    mission_current_hz: Annotated[float, _rate("MISSION_CURRENT")] = 1.0
    high_latency2_hz: Annotated[
        float, _rate("HIGH_LATENCY2, only to links of less than 100 bytes/s,")
    ] = 0.2
    battery_status_hz: Annotated[float, _rate("BATTERY_STATUS of each node")] = 1.0


class VehicleSettings(Settings, frozen=True):
    """The vehicle that ground stations see; one per aircraft."""

    type: Annotated[
        VehicleType, setting("Vehicle type, by which ground stations choose icon and display.")
    ] = "fixed_wing"
    autopilot: Annotated[
        Autopilot,
        setting(
            "Autopilot that the vehicle reports in HEARTBEAT. Keep generic unless a program "
            "accepts only the others (Cockpit): with those, ground stations show set-up pages, "
            "modes and parameters of that autopilot, which do not exist here."
        ),
    ] = "generic"
    operator_control: Annotated[
        OperatorControl,
        setting(
            "Which ground stations may change things: open, every trusted one; exclusive, only the "
            "one that has requested control, as QGroundControl 5 does."
        ),
    ] = "open"
    rates: RateSettings = RateSettings()
    armed_when: Annotated[
        ArmedWhen,
        setting(
            "When the vehicle reports itself armed. Ground stations base flight time, distance, "
            "track and their own logs on it."
        ),
    ] = "flying_or_recording"
    signing_passphrase: Annotated[
        str,
        setting(
            "MAVLink 2 signing: the same passphrase as in the ground station. Everything sent is "
            "then signed, and changes are accepted only with a signature. Empty for none. "
            "`mavgate clients reload` applies a changed one."
        ),
    ] = ""
    node_silent_s: Annotated[
        float,
        setting(
            "A node or sensor that has sent no data for this time is unhealthy.",
            "s",
            ge=0.2,
            le=60.0,
        ),
    ] = 2.0
    supply_low_v: Annotated[
        float,
        setting(
            "A node whose supply falls below this is announced as STATUSTEXT, as its radio and "
            "sensors fail soon after; 0 disables this.",
            "V",
            ge=0.0,
            le=12.0,
        ),
    ] = 3.0
    home_accuracy_m: Annotated[
        float,
        setting(
            "Home is set at the first 3D fix whose horizontal accuracy is at least this good.",
            "m",
            ge=0.5,
            le=100.0,
        ),
    ] = 5.0
    home_satellites: Annotated[
        int, setting("Least number of satellites of the fix that sets home.", "", ge=4, le=20)
    ] = 6
    takeoff_speed_mps: Annotated[
        float,
        setting(
            "Ground speed above which, held for two seconds, the vehicle is in the air.",
            "m/s",
            ge=0.5,
            le=50.0,
        ),
    ] = 5.0
    takeoff_height_m: Annotated[
        float,
        setting(
            "Height above the first good fix above which, held for two seconds, the vehicle is in "
            "the air.",
            "m",
            ge=1.0,
            le=100.0,
        ),
    ] = 10.0
