"""Write tests/vectors/frames.json: the exact bytes of every payload and frame kind.

The Python tests and the firmware's host tests both read the table, so the two implementations of
firmware/PROTOCOL.md stay equal. Run it only when the protocol itself changes.
"""

import json
from datetime import UTC, datetime
from pathlib import Path

import msgspec

from gateway.records import GpsFixType, ImuFlags, NodeId, PipeCounters, RadioState
from gateway.wire import payloads
from gateway.wire.framing import encode_frame
from gateway.wire.payloads import Chips

TARGET = Path(__file__).resolve().parent.parent / "tests" / "vectors" / "frames.json"

LEVEL = payloads.ImuPayload(
    accel=(0, 0, 4096),
    gyro=(-12, 3, 0),
    mag=(218, 0, -431),
    temperature=-3920,
    flags=ImuFlags.MAG_NEW,
    accel_range=2,
    gyro_range=1,
    mag_gain=1,
)
QMC5883L = msgspec.structs.replace(
    LEVEL, gyro=(0, 0, 0), mag=(600, -4095, -32768), gyro_range=2, mag_gain=8
)
NODE_STATUS = payloads.NodeStatusPayload(
    firmware_version=(1, 2),
    reset_cause=8,
    sensors_present=7,
    sensors_failed=0,
    bus_errors=3,
    radio_failed=12,
    radio_retries=65_535,
    loop_max_us=812,
    sample_rate_hz=100,
    supply_mv=3300,
)

RADIO: dict[str, tuple[payloads.Header, payloads.Payload]] = {
    "imu_level": (payloads.Header(NodeId(1, 0), 7, 1_000_000), LEVEL),
    "imu_extremes": (
        payloads.Header(NodeId(31, 7), 65535, 4_294_967_295),
        payloads.ImuPayload(
            accel=(-32768, 32767, -1),
            gyro=(32767, -32768, 1),
            mag=(-4096, 2047, -2048),
            temperature=-32768,
            flags=ImuFlags(0xFF),
            accel_range=3,
            gyro_range=3,
            mag_gain=7,
        ),
    ),
    "imu_zeros": (
        payloads.Header(NodeId(1, 0), 0, 0),
        payloads.ImuPayload((0, 0, 0), (0, 0, 0), (0, 0, 0), 0, ImuFlags(0), 0, 0, 0),
    ),
    "baro_sea_level": (
        payloads.Header(NodeId(1, 0), 8, 1_002_500),
        payloads.BaroPayload(pressure_centipa=10_132_500, temperature_ddegc=250),
    ),
    "baro_cold": (
        payloads.Header(NodeId(2, 0), 300, 90_000_000),
        payloads.BaroPayload(pressure_centipa=3_000_012, temperature_ddegc=-400),
    ),
    "gps_fix_3d": (
        payloads.Header(NodeId(1, 1), 41, 8_123_456),
        payloads.GpsFixPayload(
            itow_ms=345_600_200,
            lat_dege7=-77_123_456,
            lon_dege7=1_103_654_321,
            alt_amsl_mm=153_250,
            vel_n_cmps=(1234, -567, -89),
            fix_type=GpsFixType.FIX_3D,
            fix_ok=True,
            satellites=14,
        ),
    ),
    "gps_no_fix": (
        payloads.Header(NodeId(1, 1), 1, 250_000),
        payloads.GpsFixPayload(0, 0, 0, 0, (0, 0, 0), GpsFixType.NONE, False, 0),
    ),
    "gps_fix_extremes": (
        payloads.Header(NodeId(31, 1), 65_280, 16_777_216),
        payloads.GpsFixPayload(
            itow_ms=604_799_900,
            lat_dege7=900_000_000,
            lon_dege7=-1_800_000_000,
            alt_amsl_mm=-2_147_483_648,
            vel_n_cmps=(-32_767, 32_767, -32_768),
            fix_type=GpsFixType.TIME_ONLY,
            fix_ok=False,
            satellites=255,
        ),
    ),
    "gps_quality_utc": (
        payloads.Header(NodeId(1, 1), 40, 8_123_456),
        payloads.GpsQualityPayload(
            itow_ms=345_600_200,
            h_acc_cm=180,
            v_acc_cm=310,
            speed_acc_cmps=42,
            course_acc_cdeg=275,
            pdop_centi=161,
            geoid_separation_cm=2_345,
            utc=datetime(2026, 11, 19, 0, 0, 2, 200_000, tzinfo=UTC),
        ),
    ),
    "gps_quality_no_time": (
        payloads.Header(NodeId(1, 1), 0, 249_000),
        payloads.GpsQualityPayload(0, 65_535, 65_535, 65_535, 65_535, 9_999, -32_768, None),
    ),
    "node_status": (payloads.Header(NodeId(1, 0), 512, 60_000_000), NODE_STATUS),
    "imu_qmc5883l": (payloads.Header(NodeId(1, 0), 9, 1_010_000), QMC5883L),
    "imu_qmc5883p_overflow": (
        payloads.Header(NodeId(1, 0), 10, 1_020_000),
        msgspec.structs.replace(QMC5883L, mag=(-4096, -4096, -4096), mag_gain=9),
    ),
    "node_status_imu_chips": (
        payloads.Header(NodeId(1, 0), 513, 61_000_000),
        msgspec.structs.replace(
            NODE_STATUS,
            firmware_version=(1, 1),
            reset_cause=1,
            sensors_failed=2,
            radio=RadioState.ACTIVATED,
            chips=Chips(imu=0x98, magnetometer=0x2C, barometer=0x60),
        ),
    ),
    "node_status_gps_chips": (
        payloads.Header(NodeId(1, 1), 77, 61_500_000),
        payloads.NodeStatusPayload(
            firmware_version=(1, 1),
            reset_cause=8,
            sensors_present=8,
            sensors_failed=0,
            bus_errors=0,
            radio_failed=0,
            radio_retries=2,
            loop_max_us=790,
            sample_rate_hz=5,
            supply_mv=0,
            chips=Chips(gps=0x1A, gps_baud_hundreds=576),
        ),
    ),
}
"""Vectors; append new ones, since the position is the sequence number and sets the pipe."""

RECEIVER_STATUS = {
    "receiver_status": payloads.ReceiverStatusFrame(
        frame_seq=255,
        receiver_time_us=61_000_000,
        channel=76,
        noise_percent=4,
        uart_dropped=1,
        reset_cause=1,
        pipes=(
            PipeCounters(6_000, 12, 0),
            PipeCounters(600, 1, 0),
            *(PipeCounters(0, 0, 0),) * 3,
            PipeCounters(4_294_967_295, 65_536, 65_535),
        ),
    ),
    "receiver_status_radio_forgets": payloads.ReceiverStatusFrame(
        frame_seq=3,
        receiver_time_us=2_000_000,
        channel=76,
        noise_percent=0,
        uart_dropped=0,
        reset_cause=1,
        pipes=(PipeCounters(0, 0, 0),) * 6,
        radio=RadioState.LOSES_SETTINGS,
    ),
}


def _plain(record: object) -> object:
    return msgspec.to_builtins(record, builtin_types=(datetime,))


def main() -> None:
    """Build every vector and write the table."""
    vectors = []
    for frame_seq, (name, (header, payload)) in enumerate(RADIO.items()):
        packet = payloads.encode_payload(header, payload)
        pipe, receiver_time_us = frame_seq % payloads.PIPES, 5_000_000 + frame_seq
        content = payloads.encode_radio(frame_seq, pipe, receiver_time_us, packet)
        vectors.append(
            {
                "name": name,
                "kind": type(payload).__name__,
                "frame_seq": frame_seq,
                "pipe": pipe,
                "receiver_time_us": receiver_time_us,
                "header": _plain(header),
                "fields": _plain(payload),
                "payload_hex": packet.hex(),
                "content_hex": content.hex(),
                "frame_hex": encode_frame(content).hex(),
            }
        )
    for name, status in RECEIVER_STATUS.items():
        content = payloads.encode_receiver_status(status)
        vectors.append(
            {
                "name": name,
                "kind": "ReceiverStatus",
                "fields": _plain(status),
                "content_hex": content.hex(),
                "frame_hex": encode_frame(content).hex(),
            }
        )
    text = json.dumps(vectors, indent=1, default=lambda moment: moment.isoformat())
    TARGET.write_text(text + "\n", encoding="utf-8")
    print(f"{len(vectors)} vectors written to {TARGET}")


if __name__ == "__main__":
    main()
