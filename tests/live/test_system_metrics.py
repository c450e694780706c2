"""Metrics of all systems, and the dashboard that shows them."""

import json
import re
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.hub.frame_stream import FrameStream
from gateway.live.metrics import prometheus_text, system_families, text_of
from gateway.live.vehicle_watch import DECODED_US, MAX_SYSTEMS, VehicleWatch
from gateway.units import US_PER_S
from gateway.vehicle_state.newest import HEARD_US
from gateway.wire.mavlink_splitter import frame_of
from tests.kit.mavlink import packed
from tests.kit.messages import at, beat, gps
from tests.live.test_metrics import SNAPSHOT

ROOT = Path(__file__).resolve().parents[2]
BATTERY = mavlink.MAVLink_sys_status_message(0, 0, 0, 0, 12_400, -1, 80, 0, 0, 0, 0, 0, 0)


class Watched(VehicleWatch):
    """A watch, and the frames of each system as the hub counts them."""

    def __init__(self) -> None:
        super().__init__()
        self.received: defaultdict[tuple[int, int], FrameStream] = defaultdict(FrameStream)


def feed(systems: Watched, *messages: Any, now_us: int = 0, **sender: Any) -> None:
    for message in messages:
        frame = frame_of(packed(message, **sender))
        systems.received[frame.origin].accept(frame.sequence, 1, now_us)
        systems.update([(frame.data, now_us)], systems.received)


def lines(systems: Watched, now_us: int = 0) -> list[str]:
    text = "".join(text_of(system_families(systems, now_us)))
    return [line for line in text.splitlines() if not line.startswith("#")]


def test_values_of_a_foreign_vehicle_have_samples() -> None:
    systems = Watched()
    feed(systems, beat(), at(), gps(), BATTERY, system=9)
    feed(systems, at(alt_m=1.0), system=9, component=154)
    found = lines(systems, 2 * US_PER_S)
    for name, value in {
        "altitude_metres": 488.13, "height_metres": 20.0, "ground_speed_metres_per_second": 5.0,
        "satellites": 11.0, "battery_volts": 12.4, "battery_percent": 80.0, "armed": 1.0,
        "silent_seconds": 2.0,
    }.items():  # fmt: skip
        assert f'mavgate_system_{name}{{system="9"}} {value}' in found, name


def test_old_position_and_gone_system_have_no_samples() -> None:
    systems = Watched()
    feed(systems, beat(), at())
    assert not any("altitude" in line for line in lines(systems, 6 * US_PER_S))
    assert lines(systems, HEARD_US)
    assert lines(systems, HEARD_US + 1) == []


def test_lost_frames_are_counted_by_sequence_numbers() -> None:
    for sequences, lost in (
        ([0, 1, 2], 0.0),
        ([250, 255, 0, 4], 7.0),
        ([7, 8, 8, 7, 9], 0.0),
        ([5, 9, 6, 10], 3.0),
    ):
        systems = Watched()
        for sequence in sequences:
            feed(systems, beat(), sequence=sequence)
        feed(systems, gps(), component=154, sequence=77)
        found = lines(systems)
        assert f'mavgate_system_frames_total{{system="1"}} {float(len(sequences))}' in found
        assert f'mavgate_system_frames_lost_total{{system="1"}} {lost}' in found, sequences


def test_row_of_a_vehicle_has_mode_position_link_and_loss() -> None:
    systems = Watched()
    names = mavlink.MAVLink_available_modes_message(1, 1, 0, 7, 0, b"Survey")
    # A foreign autopilot whose modes no table has.
    mode = mavlink.MAVLink_heartbeat_message(2, 0, 129, 7, 4, 3)
    feed(systems, mode, at(), gps(), BATTERY, names, system=9)
    for sequence in (1, 2, 4):
        feed(systems, mode, system=9, sequence=sequence)
    client = replace(SNAPSHOT.clients[0], name="field radio", systems=((9, 1), (9, 154)))
    (row,) = systems.rows(2 * US_PER_S, {}, [client])
    assert (row.kind, row.mode, row.armed, row.link) == ("quadrotor", "Survey", True, "field radio")
    assert (row.alt_amsl_m, row.battery_v, row.age_s) == (488.13, 12.4, 2.0)
    assert row.loss == pytest.approx(1 / 9)
    (own,) = systems.rows(2 * US_PER_S, {9: "Tracking"}, [client])
    assert (own.mode, own.link) == ("Tracking", "receiver")
    (own,) = systems.rows(2 * US_PER_S, {9: ""}, [client], {9: "crsf:stdin", 2: "lines:stdin"})
    assert own.link == "crsf:stdin"


def test_messages_of_one_kind_are_decoded_at_intervals() -> None:
    systems = Watched()
    for alt_m, now_us in ((1.0, 0), (2.0, DECODED_US - 1), (3.0, DECODED_US)):
        feed(systems, beat(), at(alt_m=alt_m), now_us=now_us)
        shown = systems.present(now_us)[1].position
        assert shown is not None
        assert shown.alt_amsl_m == {1.0: 1.0, 2.0: 1.0, 3.0: 3.0}[alt_m]


def test_number_of_systems_is_bounded_and_room_is_made_by_those_that_have_gone() -> None:
    systems = Watched()
    for system in range(1, MAX_SYSTEMS + 10):
        feed(systems, beat(), system=system)
    assert len([line for line in lines(systems) if "armed" in line]) == MAX_SYSTEMS
    feed(systems, beat(), system=200, now_us=HEARD_US + 1)
    assert 'mavgate_system_armed{system="200"} 1.0' in lines(systems, HEARD_US + 1)


def test_dashboard_uses_metrics_that_exist() -> None:
    systems = Watched()
    feed(systems, beat(), at(), gps(), BATTERY)
    known = set(re.findall(r"^(mavgate_\w+)", "\n".join(lines(systems)), re.M))
    known |= set(re.findall(r"^(mavgate_\w+)", "".join(prometheus_text(SNAPSHOT)), re.M))
    text = (ROOT / "config" / "grafana-dashboard.json").read_text()
    assert json.loads(text)["panels"]
    assert set(re.findall(r"mavgate_\w+", text)) <= known
