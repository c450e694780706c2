"""Print the golden vectors of tests/vectors/frames.json as C++ for the host tests."""

import json
import sys
from datetime import datetime
from pathlib import Path
from typing import Any

FIX_OK = 0x80


def braces(values: list[int]) -> str:
    """Build a brace initialiser of numbers."""
    return "{" + ", ".join(str(value) for value in values) + "}"


def header(vector: dict[str, Any], kind: int) -> str:
    """Build the initialiser of a payload header."""
    head = vector["header"]
    node = head["node"]
    address = f"wire_vehicle_node({node['vehicle_id']}, {node['node_id']})"
    return f"{{wire_version_kind({kind}), {address}, {head['seq']}, {head['node_time_us']}u}}"


def imu(f: dict[str, Any]) -> str:
    """Build the body of an IMU payload."""
    axes = ", ".join(braces(f[name]) for name in ("accel", "gyro", "mag"))
    ranges = f"wire_ranges({f['accel_range']}, {f['gyro_range']}, {f['mag_gain']})"
    return f"{axes}, {f['temperature']}, {f['flags']}, {ranges}"


def gps_fix(f: dict[str, Any]) -> str:
    """Build the body of a GPS fix."""
    fix = f["fix_type"] | (FIX_OK if f["fix_ok"] else 0)
    place = f"{f['itow_ms']}u, {f['lat_dege7']}, {f['lon_dege7']}, INT32_C({f['alt_amsl_mm']})"
    return f"{place}, {braces(f['vel_n_cmps'])}, {fix}, {f['satellites']}"


def gps_quality(f: dict[str, Any]) -> str:
    """Build the body of a GPS quality payload."""
    names = ("itow_ms", "h_acc_cm", "v_acc_cm", "speed_acc_cmps", "course_acc_cdeg", "pdop_centi")
    moment = [0] * 8
    if f["utc"]:
        utc = datetime.fromisoformat(f["utc"])
        day = [1, utc.year - 2000, utc.month, utc.day]
        moment = [*day, utc.hour, utc.minute, utc.second, utc.microsecond // 10_000]
    numbers = [*(f[name] for name in names), f["geoid_separation_cm"], *moment]
    return ", ".join(str(number) for number in numbers)


def node_status(f: dict[str, Any]) -> str:
    """Build the body of a node status."""
    names = (
        "sensors_present", "sensors_failed", "bus_errors", "radio_failed", "radio_retries",
        "loop_max_us", "sample_rate_hz", "supply_mv",
    )  # fmt: skip
    numbers = [*f["firmware_version"], reset_and_radio(f), *(f[n] for n in names)]
    return ", ".join([*map(str, numbers), braces(list(f["chips"].values()))])


def reset_and_radio(f: dict[str, Any]) -> int:
    """Join reset cause and state of the radio module."""
    return int(f["reset_cause"] | f["radio"] << 4)


BODIES = {
    "ImuPayload": ("WireImu", 1, imu),
    "BaroPayload": (
        "WireBaro",
        2,
        lambda f: f"{f['pressure_centipa']}u, {f['temperature_ddegc']}",
    ),
    "GpsFixPayload": ("WireGpsFix", 3, gps_fix),
    "GpsQualityPayload": ("WireGpsQuality", 4, gps_quality),
    "NodeStatusPayload": ("WireNodeStatus", 5, node_status),
}


def radio_vector(vector: dict[str, Any]) -> str:
    """Build one entry of the table of radio payloads."""
    struct, kind, body = BODIES[vector["kind"]]
    value = f"{struct}{{{header(vector, kind)}, {body(vector['fields'])}}}"
    place = f"{vector['frame_seq']}, {vector['pipe']}, {vector['receiver_time_us']}u"
    images = ", ".join(f'"{vector[f"{name}_hex"]}"' for name in ("payload", "content", "frame"))
    return f'    {{"{vector["name"]}", bytes_of({value}), {place}, {images}}},'


def status_vector(vector: dict[str, Any]) -> str:
    """Build the entry of a receiver status."""
    f = vector["fields"]
    pipes = ", ".join(f"{{{p['received']}u, {p['lost']}u, {p['overruns']}}}" for p in f["pipes"])
    head = f"{{wire_version_kind(2), {f['frame_seq']}, WIRE_NO_PIPE, {f['receiver_time_us']}u}}"
    body = f"{f['channel']}, {f['noise_percent']}, {f['uart_dropped']}, {reset_and_radio(f)}"
    value = f"WireReceiverStatus{{{head}, {body}, {{{pipes}}}}}"
    images = f'"{vector["content_hex"]}", "{vector["frame_hex"]}"'
    return f'    {{"{vector["name"]}", bytes_of({value}), 0, 0, 0u, "", {images}}},'


def main() -> None:
    """Write the table to standard output."""
    vectors = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    table = [radio_vector(v) if v["kind"] in BODIES else status_vector(v) for v in vectors]
    head = "// Written by vectors_header.py out of frames.json.\n"
    sys.stdout.write(f"{head}static const std::vector<Vector> VECTORS = {{\n")
    sys.stdout.write("\n".join([*table, "};", ""]))


if __name__ == "__main__":
    main()
