"""Requests of real ground stations to a running gateway."""

import asyncio
import json
import math
import socket
import time
from collections.abc import Awaitable, Callable, Iterator
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from mavsdk.asyncio.plugins.component_metadata import (
    ComponentMetadataAsync,
    ComponentMetadataError,
    MetadataType,
)
from mavsdk.asyncio.plugins.info import InfoAsync
from mavsdk.asyncio.plugins.mission_raw import MissionItem, MissionRawAsync
from mavsdk.asyncio.plugins.param import ParamAsync
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
from mavsdk.exceptions import MavsdkError
from mavsdk.plugins.param import ParamError, ParamResult
from pymavlink.dialects.v20 import common as mavlink

from tests.end_to_end.processes import (
    HOME,
    NEAR_DEG,
    STEEPEST_DEG,
    Gateway,
    MavProxy,
    first_position,
    mavsdk_system,
)
from tests.end_to_end.station import Station
from tests.kit.ground_station import qgroundcontrol
from tests.kit.process import START_LIMIT_S

CONFIG = """
[hub]
endpoints = [
    "udp:127.0.0.1:{port}", "udp-listen:127.0.0.1:{listen}", "tcp-listen:127.0.0.1:{listen}",
]

[simulator]
gps_first_fix_s = 0.5
"""

WAYPOINTS = "\n".join(
    [
        "QGC WPL 110",
        *(
            f"{seq}\t{int(seq == 0)}\t3\t16\t0\t0\t0\t0\t{HOME.home_lat_deg}\t{lon_deg}\t50\t1"
            for seq, lon_deg in enumerate((HOME.home_lon_deg, HOME.home_lon_deg + 0.01))
        ),
    ]
)

IN_A_ROW = 10

GAVE_UP = {"TIMEOUT", "INFORMATION_NOT_RECEIVED_YET", "TRANSFER_CANCELLED"}

pytestmark = [pytest.mark.io, pytest.mark.slow]


async def answered(ask: Callable[..., Awaitable[Any]], *words: Any) -> Any:
    """Ask by MAVSDK until there is an answer: its timeouts are too short for a busy machine."""
    while True:
        try:
            return await ask(*words)
        except MavsdkError as error:
            if error.result.name not in GAVE_UP:
                raise
        await asyncio.sleep(0.1)


@pytest.fixture(scope="module")
def gateway(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Gateway]:
    """Start one gateway for all tests: each start takes seconds, and no test changes it."""
    running = Gateway(tmp_path_factory.mktemp("gateway"), "demo", config=CONFIG)
    yield running
    assert running.end() == 0
    assert "Traceback" not in running.log.read_text()


@pytest.fixture
def stations(gateway: Gateway) -> Iterator[Callable[..., Station]]:
    opened: list[Station] = []

    def connect(kind: int, version: int) -> Station:
        deadline_s = time.monotonic() + START_LIMIT_S
        while True:
            try:
                station = Station.connect(kind, gateway.listen_port, version)
                opened.append(station)
                station.until_heard(1.0)
            except (ConnectionError, AssertionError):
                assert time.monotonic() < deadline_s, gateway.log.read_text()
                time.sleep(0.2)
            else:
                return station

    yield connect
    for station in opened:
        station.close()


def test_qgroundcontrol_start_up_is_answered(stations: Callable[..., Station]) -> None:
    for kind in (socket.SOCK_DGRAM, socket.SOCK_STREAM):
        for version in (1, 2):
            qgroundcontrol(stations(kind, version))


async def test_mavsdk_reads_health_home_position_and_attitude(gateway: Gateway) -> None:
    async with mavsdk_system(gateway.port) as system:
        telemetry = TelemetryAsync(system)
        position = await first_position(telemetry)
        assert position.latitude_deg == pytest.approx(HOME.home_lat_deg, abs=NEAR_DEG)
        assert position.longitude_deg == pytest.approx(HOME.home_lon_deg, abs=NEAR_DEG)
        assert position.absolute_altitude_m == pytest.approx(HOME.home_alt_m, abs=100.0)
        attitude = await anext(telemetry.subscribe_attitude_euler())
        assert abs(attitude.roll_deg) < STEEPEST_DEG
        async for health in telemetry.subscribe_health():
            if (
                health.is_armable
                and health.is_home_position_ok
                and health.is_gyrometer_calibration_ok
                and health.is_accelerometer_calibration_ok
                and health.is_magnetometer_calibration_ok
                and health.is_global_position_ok
            ):
                break
        home = await anext(telemetry.subscribe_home())
        assert home.latitude_deg == pytest.approx(HOME.home_lat_deg, abs=1e-3)
        quaternion = await anext(telemetry.subscribe_attitude_quaternion())
        norm = math.hypot(quaternion.w, quaternion.x, quaternion.y, quaternion.z)
        assert norm == pytest.approx(1.0, abs=1e-5)
        metrics = await anext(telemetry.subscribe_fixedwing_metrics())
        assert metrics.airspeed_m_s == metrics.groundspeed_m_s, "nothing measures the airspeed"
        assert abs(metrics.climb_rate_m_s) < 8.0


async def test_mavsdk_sets_stream_rates_above_those_of_the_settings(gateway: Gateway) -> None:
    """Every set_rate is acknowledged, and a client gets more than the settings' 50 Hz."""

    async with mavsdk_system(gateway.port) as system:
        telemetry = TelemetryAsync(system)
        for set_rate in (
            telemetry.set_rate_position,
            telemetry.set_rate_home,
            telemetry.set_rate_health,
            telemetry.set_rate_fixedwing_metrics,
            telemetry.set_rate_landed_state,
        ):
            await answered(set_rate, 20.0)
        await answered(telemetry.set_rate_attitude_quaternion, 100.0)
        # By the samples' stamps, which no load brings closer together: it only leaves some out.
        stamps = [0] * (IN_A_ROW + 1)
        async for quaternion in telemetry.subscribe_attitude_quaternion():
            stamps = [*stamps[1:], quaternion.timestamp_us]
            if all(0 < b - a <= 12_000 for a, b in pairwise(stamps)):
                break


async def test_mavsdk_reads_local_position_altitude_odometry_and_imu(gateway: Gateway) -> None:
    async with mavsdk_system(gateway.port) as system:
        telemetry = TelemetryAsync(system)
        for set_rate in (
            telemetry.set_rate_position_velocity_ned,
            telemetry.set_rate_altitude,
            telemetry.set_rate_odometry,
            telemetry.set_rate_raw_imu,
            telemetry.set_rate_scaled_imu,
        ):
            await answered(set_rate, 10.0)
        local = await anext(telemetry.subscribe_position_velocity_ned())
        assert math.hypot(local.position.north_m, local.position.east_m) < 50_000.0
        altitude = await anext(telemetry.subscribe_altitude())
        assert altitude.altitude_relative_m == pytest.approx(altitude.altitude_local_m, abs=50.0)
        odometry = await anext(telemetry.subscribe_odometry())
        assert odometry.position_body.x_m == pytest.approx(local.position.north_m, abs=200.0)
        for subscribe in (telemetry.subscribe_raw_imu, telemetry.subscribe_scaled_imu):
            imu = await anext(subscribe())
            assert math.isfinite(imu.acceleration_frd.down_m_s2)
        origin = await answered(telemetry.get_gps_global_origin)
        assert origin.latitude_deg == pytest.approx(HOME.home_lat_deg, abs=1e-3)


def test_dronekit_uploads_and_downloads_a_mission(gateway: Gateway) -> None:
    """DroneKit knows only the older messages with floats."""
    dronekit = pytest.importorskip("dronekit")
    vehicle = dronekit.connect(
        f"tcp:127.0.0.1:{gateway.listen_port}", wait_ready=False, heartbeat_timeout=START_LIMIT_S
    )
    try:
        commands = vehicle.commands
        commands.clear()
        for seq in range(5):
            lat_deg = HOME.home_lat_deg + 0.001 * seq
            commands.add(
                dronekit.Command(
                    0, 0, 0, mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT, mavlink.MAV_CMD_NAV_WAYPOINT,
                    0, 1, 0, 0, 0, 0, lat_deg, HOME.home_lon_deg, 50.0 + seq,
                )
            )  # fmt: skip
        commands.upload(timeout=START_LIMIT_S)
        commands.download()
        commands.wait_ready(timeout=START_LIMIT_S)
        assert [round(command.z) for command in commands][-3:] == [52, 53, 54]
    finally:
        vehicle.close()


async def test_mavsdk_reads_and_sets_parameters_within_their_ranges(gateway: Gateway) -> None:
    async with mavsdk_system(gateway.port) as system:
        info, param = InfoAsync(system), ParamAsync(system)
        version = await answered(info.get_version)
        assert version.flight_sw_minor > 0
        names: set[str] = set()
        while not {"PAPER_ACC_CUTOFF", "RATE_ATT_QUAT"} <= names:
            everything = await param.get_all_params()
            names = {each.name for each in everything.float_params}
        await answered(param.set_param_float, "PAPER_ACC_CUTOFF", 12.5)
        assert await answered(param.get_param_float, "PAPER_ACC_CUTOFF") == 12.5
        with pytest.raises(ParamError) as refused:
            await answered(param.set_param_float, "PAPER_ACC_CUTOFF", 1e9)
        assert refused.value.result == ParamResult.VALUE_OUT_OF_RANGE
        with pytest.raises(ParamError):
            await answered(param.get_param_float, "NO_SUCH")


async def test_mavsdk_reads_the_parameters_metadata_over_ftp(gateway: Gateway) -> None:
    async with mavsdk_system(gateway.port) as system:
        metadata = ComponentMetadataAsync(system)
        await metadata.request_autopilot_component()
        while True:
            try:
                found = await metadata.get_metadata(1, MetadataType.PARAMETER)
            except ComponentMetadataError:
                await asyncio.sleep(0.1)
            else:
                break
        described = {p["name"]: p for p in json.loads(found.json_metadata)["parameters"]}
        assert described["PAPER_ACC_CUTOFF"]["units"] == "Hz"


async def test_mavsdk_uploads_downloads_and_clears_a_mission(gateway: Gateway) -> None:
    def item(seq: int) -> MissionItem:
        return MissionItem(
            seq=seq,
            frame=mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT,
            command=mavlink.MAV_CMD_NAV_WAYPOINT,
            current=int(seq == 0),
            autocontinue=1,
            x=round(HOME.home_lat_deg * 1e7) + 1000 * seq,
            y=round(HOME.home_lon_deg * 1e7),
            z=50.0 + seq,
        )

    async with mavsdk_system(gateway.port) as system:
        missions = MissionRawAsync(system)
        items = [item(seq) for seq in range(25)]
        await answered(missions.upload_mission, items)
        found = await answered(missions.download_mission)
        assert [(i.seq, i.x, i.y, i.z) for i in found] == [(i.seq, i.x, i.y, i.z) for i in items]
        await answered(missions.set_current_mission_item, 3)
        await answered(missions.clear_mission)
        assert await answered(missions.download_mission) == []


def test_mavproxy_sees_two_vehicles_with_id_1_as_1_and_2(
    tmp_path: Path, gateway: Gateway, start_mavproxy: Callable[[int], MavProxy]
) -> None:
    """Two gateways fly a vehicle 1 each, and a third joins them without one of its own."""
    folders = [tmp_path / name for name in ("other", "router")]
    for folder in folders:
        folder.mkdir()
    with ExitStack() as ending:
        flying = [gateway, ending.enter_context(Gateway(folders[0], "demo", config=CONFIG))]
        first, second = (each.listen_port for each in flying)
        urls = f'"tcp:127.0.0.1:{first}", "tcp:127.0.0.1:{second}?as=2", "udp:127.0.0.1:{{port}}"'
        config = f"[hub]\nendpoints = [{urls}]"
        router = ending.enter_context(Gateway(folders[1], "run", config=config))
        mavproxy = start_mavproxy(router.port)
        mavproxy.until(r"Detected vehicle 1:1")
        mavproxy.until(r"Detected vehicle 2:1")
        mavproxy.type("vehicle 2")
        # Refused until the parameters are loaded.
        words = ("param set PAPER_ACC_CUTOFF 13.5", "param show PAPER_ACC_CUTOFF")
        mavproxy.until(r"PAPER_ACC_CUTOFF\s+13\.5", asking="\n".join(words))
        values = []
        request = mavlink.MAVLink_param_request_read_message(1, 1, b"PAPER_ACC_CUTOFF", -1)
        for each in flying:
            station = Station.connect(socket.SOCK_DGRAM, each.listen_port, 2)
            values += [found.param_value for found in station.ask(request, "PARAM_VALUE")]
            station.close()
        assert values[0] != values[1] == 13.5


def test_mavproxy_loads_parameters_and_uploads_a_mission(
    gateway: Gateway, start_mavproxy: Callable[[int], MavProxy], tmp_path: Path
) -> None:
    """Load the parameters, set one, upload waypoints and see the way to them."""
    (tmp_path / "way.txt").write_text(WAYPOINTS)
    mavproxy = start_mavproxy(gateway.port)
    mavproxy.until(r"Received \d+ parameters")
    mavproxy.type("param set PAPER_ACC_CUTOFF 12.5")
    mavproxy.until(r"PAPER_ACC_CUTOFF\s+12\.5", asking="param show PAPER_ACC_CUTOFF")
    mavproxy.type("wp load way.txt")
    mavproxy.until(r"Got MISSION_ACK: TYPE_MISSION: ACCEPTED")
    mavproxy.until(r"wp_dist : \d+", asking="status NAV_CONTROLLER_OUTPUT")
    mavproxy.until(r"airspeed : \d\S*, groundspeed : \d", asking="status VFR_HUD")
    mavproxy.until(r"link 1 OK", asking="link")
    pattern = r"GLOBAL_POSITION_INT \{.*?lat : (-?\d+), lon : (-?\d+),"
    position = mavproxy.until(pattern, asking="status GLOBAL_POSITION_INT")
    assert int(position[1]) / 1e7 == pytest.approx(HOME.home_lat_deg, abs=NEAR_DEG)
    assert int(position[2]) / 1e7 == pytest.approx(HOME.home_lon_deg, abs=NEAR_DEG)
    pattern = r"ATTITUDE \{.*?roll : (\S+), pitch : (\S+),"
    attitude = mavproxy.until(pattern, asking="status ATTITUDE")
    assert max(abs(float(angle)) for angle in attitude.groups()) < math.radians(STEEPEST_DEG)
    assert "breach" not in mavproxy.output
