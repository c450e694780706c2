"""Time on the air of LoRa packets, and the settings that fit the channel."""

import pytest
from msgspec.structs import replace

from firmware.rig.sx1276 import LoraPacket
from gateway.flashing.airtime import airtime_s, check, share
from gateway.flashing.boards import BoardSettings, FlashError, Program

IMU = BoardSettings(radio="sx1276", imu_send_hz=10, gps_rate_hz=1)


@pytest.mark.parametrize(
    ("spreading", "bandwidth_khz", "coding", "size", "expected_ms"),
    [
        (7, 125, 5, 10, 41.216),
        (9, 125, 5, 20, 185.344),
        (7, 250, 5, 32, 35.968),
        (10, 500, 8, 33, 156.160),
    ],
)
def test_airtime_is_that_of_the_datasheet(
    spreading: int, bandwidth_khz: int, coding: int, size: int, expected_ms: float
) -> None:
    settings = replace(
        IMU, lora_spreading=spreading, lora_bandwidth_khz=bandwidth_khz, lora_coding=coding
    )
    assert 1000 * airtime_s(settings, size) == pytest.approx(expected_ms, abs=1e-3)
    packet = LoraPacket(868_300, spreading, bandwidth_khz, coding, 0x12, bytes(size))
    assert packet.duration_ps * 1e-9 == pytest.approx(expected_ms, abs=1e-3)


@pytest.mark.parametrize(
    ("program", "changes", "most", "advice"),
    [
        (Program.IMU, {}, 0.45, None),
        (Program.GPS, {}, 0.45, None),
        (Program.IMU, {"imu_send_hz": 20}, 0.45, "--send-rate 11 would fit"),
        (Program.IMU, {"lora_spreading": 8}, 0.45, "--send-rate 5 would fit"),
        (Program.GPS, {"gps_rate_hz": 10}, 0.45, "--gps-rate 6 would fit"),
        (Program.IMU, {"lora_spreading": 10, "lora_bandwidth_khz": 125}, 0.45, "--bandwidth 500"),
        (Program.IMU, {}, 0.01, "no rate fits"),
        (Program.IMU, {"lora_frequency_khz": 600_000}, 0.45, "600 MHz is in none of"),
    ],
)
def test_settings_that_do_not_fit_the_channel_are_refused_with_some_that_do(
    program: Program, changes: dict[str, int], most: float, advice: str | None
) -> None:
    settings = replace(IMU, **changes)
    if advice is None:
        assert check(program, settings, most) == share(program, settings) < most
        return
    with pytest.raises(FlashError, match=advice):
        check(program, settings, most)
