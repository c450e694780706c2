"""MCAP as its own reader opens it, and the layout that shows it."""

import json
import math
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.summary import Summary
from pymavlink.dialects.v20 import all as mavlink

from gateway.geometry.quaternion import rotate
from gateway.recordings.recording import open_recording
from gateway.recordings.workshop.convert import WRITERS, FlightToWrite, Fusing
from tests.kit.cli import invoke
from tests.kit.recordings import records_sent, write_tlog
from tests.recordings.flights import OPTIONS
from tests.recordings.formats import flown

pytestmark = pytest.mark.io

ROOT = Path(__file__).resolve().parents[3]
Message = tuple[str, str, int, dict[str, Any]]
"""Topic, name of its schema, log time in ns, content."""


def messages_of(path: Path) -> list[Message]:
    with path.open("rb") as stream:
        return [
            (channel.topic, schema.name if schema else "", m.log_time, json.loads(m.data))
            for schema, channel, m in make_reader(stream).iter_messages()
        ]


def summary_of(path: Path) -> Summary:
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return summary


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a simulated flight, out of its log, as MCAP."""
    folder = tmp_path_factory.mktemp("mcap")
    log = flown.write(folder / "flight.ulg", flown.make_ulog())
    out = folder / "flight.mcap"
    out.write_bytes(
        b"".join(
            WRITERS[".mcap"](
                FlightToWrite([open_recording(log)], OPTIONS, fusing=Fusing(wanted=True))
            )
        )
    )
    return out


@pytest.fixture(scope="module")
def shown(flight: Path) -> list[Message]:
    return messages_of(flight)


def of(shown: list[Message], topic: str) -> Iterator[tuple[float, dict[str, Any]]]:
    """Yield what a topic has, with its time since the records began."""
    begin_ns = shown[0][2]
    return ((1e-9 * (ns - begin_ns), content) for name, _, ns, content in shown if name == topic)


def test_every_message_has_the_fields_of_its_schema(flight: Path, shown: list[Message]) -> None:
    summary = summary_of(flight)
    schemas = {s.name: json.loads(s.data) for s in summary.schemas.values()}
    assert {s.encoding for s in summary.schemas.values()} == {"jsonschema"}
    assert {c.message_encoding for c in summary.channels.values()} == {"json"}
    for name in ("FrameTransform", "PoseInFrame", "LocationFix", "Log"):
        assert f"foxglove.{name}" in schemas
    for _, name, _, content in shown[::7]:
        assert set(content) == set(schemas[name]["properties"])


def test_location_fixes_match_the_true_position(shown: list[Message]) -> None:
    fixes = [(t, fix) for t, fix in of(shown, "/vehicle_7/location") if t > 30]
    truth = flown.simulated().trajectory.truth_at(np.array([t for t, _ in fixes]))
    for k, (_, fix) in enumerate(fixes):
        assert fix["latitude"] == pytest.approx(truth.lat_deg[k], abs=1e-4)
        assert fix["longitude"] == pytest.approx(truth.lon_deg[k], abs=1e-4)
        assert fix["altitude"] == pytest.approx(truth.alt_amsl_m[k], abs=10.0)
        assert fix["position_covariance_type"] == 2
        east, north, up = (fix["position_covariance"][i] for i in (0, 4, 8))
        assert 0.01 < east == north < 100.0
        assert 0.01 < up < 400.0
    assert {fix["position_covariance_type"] for _, fix in of(shown, "/vehicle_7/gps")} == {2}


def test_poses_match_the_true_attitude(shown: list[Message]) -> None:
    poses = [(t, pose) for t, pose in of(shown, "/vehicle_7/pose") if t > 30]
    assert len(poses) > 1000
    truth = flown.simulated().trajectory.truth_at(np.array([t for t, _ in poses]))
    for k in range(0, len(poses), 50):
        q = poses[k][1]["pose"]["orientation"]
        forward = rotate((q["w"], q["x"], q["y"], q["z"]), (1.0, 0.0, 0.0))
        north, east, down = rotate(tuple(truth.q_nb[k]), (1.0, 0.0, 0.0))
        assert forward == pytest.approx((east, north, -down), abs=0.2)
        left = rotate((q["w"], q["x"], q["y"], q["z"]), (0.0, 1.0, 0.0))
        north, east, down = rotate(tuple(truth.q_nb[k]), (0.0, -1.0, 0.0))
        assert left == pytest.approx((east, north, -down), abs=0.2)
    last = poses[-1][1]["pose"]["position"]
    (_, first_fix), (_, last_fix) = (list(of(shown, "/vehicle_7/location"))[i] for i in (0, -1))
    north_m = math.radians(last_fix["latitude"] - first_fix["latitude"]) * 6_371_000
    assert last["y"] == pytest.approx(north_m, rel=0.02, abs=3.0)
    assert last["z"] == pytest.approx(last_fix["altitude"] - first_fix["altitude"], abs=1.0)
    (_, transform) = list(of(shown, "/tf"))[-1]
    assert (transform["parent_frame_id"], transform["child_frame_id"]) == ("map", "vehicle_7")
    assert transform["translation"] == last


def test_state_matches_the_truth_in_degrees(shown: list[Message]) -> None:
    states = [(t, s) for t, s in of(shown, "/vehicle_7/state") if t > 30]
    truth = flown.simulated().trajectory.truth_at(np.array([t for t, _ in states]))
    speeds = np.hypot(truth.vel_n_mps[:, 0], truth.vel_n_mps[:, 1])
    errors = np.array([s["speed_mps"] for _, s in states]) - speeds
    assert np.median(np.abs(errors)) < 1
    assert max(s["height_m"] for _, s in states) > 5
    assert all(0 <= s["heading_deg"] < 360 for _, s in states)


def test_every_message_of_a_tlog_is_written(tmp_path: Path) -> None:
    one, station = "/mavlink/3/1/", "/mavlink/255/190/"
    battery = mavlink.MAVLink_battery_status_message(0, 0, 0, 99, [4000] * 10, -1, -1, -1, 50)
    messages = [
        (one, mavlink.MAVLink_heartbeat_message(1, 3, 0, 0, 4, 3)),
        (station, mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)),
        (one, mavlink.MAVLink_statustext_message(2, b"motor lost")),
        (one, mavlink.MAVLink_statustext_message(6, b"A" * 50, 5, 0)),
        (one, mavlink.MAVLink_statustext_message(6, b"end", 5, 1)),
        (station, mavlink.MAVLink_statustext_message(6, b"not the vehicle's")),
        (one, mavlink.MAVLink_attitude_message(9, 0.5, math.nan, 0, 0, 0, 0)),
        (one, battery),
        (one, mavlink.MAVLink_param_value_message(b"RATE", 1.5, 9, 3, 0)),
    ]
    senders = {one: (3, 1), station: (255, 190)}
    records = records_sent([(senders[sender], m) for sender, m in messages])
    path = write_tlog(tmp_path / "a.tlog", records)
    invoke("convert", path, "-o", tmp_path / "a.mcap", code=0)
    found = messages_of(tmp_path / "a.mcap")
    raw = [(topic, ns) for topic, _, ns, _ in found if topic.startswith("/mavlink")]
    topics = [sender + m.msgname for sender, m in messages]
    assert raw == [(t, 1000 * r.time_us) for t, r in zip(topics, records, strict=True)]
    content = {topic: content for topic, _, _, content in found}
    assert content["/mavlink/3/1/ATTITUDE"]["pitch"] is None
    assert content["/mavlink/3/1/ATTITUDE"]["roll"] == 0.5
    assert content["/mavlink/3/1/BATTERY_STATUS"]["voltages"] == [4000] * 10
    assert content["/mavlink/3/1/PARAM_VALUE"]["param_id"] == "RATE"
    texts = [(c["level"], c["message"], c["name"]) for topic, _, _, c in found if topic == "/log"]
    assert texts == [(5, "motor lost", "vehicle_3"), (2, "A" * 50 + "end", "vehicle_3")]
    assert Counter(topic for topic, *_ in found)["/tf"] == 0


def paths_of(value: Any, key: str = "") -> Iterator[str]:
    """Yield everything in a layout that names a topic."""
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from [name] if name.startswith("/") else []
            yield from paths_of(inner, name)
    elif isinstance(value, list):
        for inner in value:
            yield from paths_of(inner, key)
    elif isinstance(value, str) and value.startswith("/"):
        yield value


def test_layout_names_topics_of_the_file(flight: Path) -> None:
    layout = json.loads((ROOT / "config" / "foxglove-layout.json").read_text())
    summary = summary_of(flight)
    fields = {
        # The layout is for vehicle 1; the flight's is 7.
        re.sub("/7/", "/1/", channel.topic.replace("_7", "_1")): json.loads(
            summary.schemas[channel.schema_id].data
        )["properties"]
        for channel in summary.channels.values()
    }
    named = list(paths_of(layout))
    assert len(named) > 12
    for path in named:
        topic, _, field = path.partition(".")
        assert topic in fields, path
        assert not field or field in fields[topic], path
    kinds = r'"((?:3D|map|Gauge|Plot|RosOut)![a-z]+)"'
    panels = set(re.findall(kinds, json.dumps(layout["layout"])))
    assert panels == set(layout["configById"])
    assert all("foxglovePanelTitle" in panel for panel in layout["configById"].values())
    assert {panel.split("!")[0] for panel in panels} == {"3D", "map", "Gauge", "Plot", "RosOut"}


def test_times_later_than_the_format_holds_are_written_as_the_latest(tmp_path: Path) -> None:
    log = flown.write(tmp_path / "flight.ulg", flown.make_ulog())
    table = tmp_path / "flight.csv"
    table.write_bytes(b"".join(WRITERS[".csv"](FlightToWrite([open_recording(log)], OPTIONS))))
    zero = r'"unix_us_at_zero":(null|-?[0-9]+)'
    table.write_text(re.sub(zero, f'"unix_us_at_zero":{2 * 10**16}', table.read_text()))
    out = tmp_path / "flight.mcap"
    out.write_bytes(b"".join(WRITERS[".mcap"](FlightToWrite([open_recording(table)], OPTIONS))))
    assert {ns for _, _, ns, _ in messages_of(out)} == {(2**64 - 1) // 1000 * 1000}
