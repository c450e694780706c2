"""docs/extend.md: each example as it stands there, added from outside the package."""

import importlib
import re
import socket
import struct
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest.mock import MagicMock

import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway import Outgoing, Pipeline, PipelineSettings
from gateway.aircraft import AircraftSettings
from gateway.estimation.select import ESTIMATORS, EstimationSettings
from gateway.extensions import ExtensionError, load_extensions
from gateway.hub.endpoint import ADDED_KINDS
from gateway.hub.hub import Hub
from gateway.hub.settings import HubSettings
from gateway.hub.transports.registry import CLIENTS
from gateway.panel.added_views import ADDED_VIEWS, add_view
from gateway.recordings.file_format import OTHER_FORMATS
from gateway.recordings.reading import READERS
from gateway.recordings.recorded_table import ReadOptions, header_for
from gateway.recordings.recording import open_recording
from gateway.recordings.rows import TableRow, row_to_line
from gateway.recordings.table import encode_head
from gateway.recordings.workshop.convert import WRITERS, FlightToWrite, Fusing
from gateway.records import ImuRaw, Incoming, NavState
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.sources.kinds import SOURCE_KINDS, make_sources
from gateway.sources.settings import SourceSettings
from gateway.vehicle.telemetry.streams import ADDED_MESSAGES
from gateway.wire.mavlink_splitter import message_id_of
from tests.kit.process import until
from tools.simulated_flight import fly

DOCUMENT = Path(__file__).resolve().parent.parent / "docs" / "extend.md"
REGISTRIES: tuple[dict, ...] = (
    ADDED_MESSAGES,
    ESTIMATORS,
    WRITERS,
    READERS,
    OTHER_FORMATS,
    CLIENTS,
    ADDED_KINDS,
    ADDED_VIEWS,
    SOURCE_KINDS,
)

Install = Callable[[str, str], None]


def example(heading: str) -> str:
    """Return the Python below a heading of the document."""
    found = re.search(rf"^## {heading}$.*?```python\n(.*?)```", DOCUMENT.read_text(), re.M | re.S)
    assert found is not None
    return found[1]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Put a module where an installed package would stand, with its entry point."""
    before = [dict(registry) for registry in REGISTRIES]
    monkeypatch.syspath_prepend(str(tmp_path))
    names: list[str] = []

    def write(name: str, source: str) -> None:
        names.append(name)
        (tmp_path / f"{name}.py").write_text(source)
        facts = tmp_path / f"{name}-1.0.dist-info"
        facts.mkdir()
        (facts / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        (facts / "entry_points.txt").write_text(f"[mavgate.extensions]\n{name} = {name}:extend\n")
        importlib.invalidate_caches()

    yield write
    for registry, kept in zip(REGISTRIES, before, strict=True):
        registry.clear()
        registry.update(kept)
    for name in names:
        sys.modules.pop(name, None)


def fly_with(settings: AircraftSettings, seconds: float) -> list[bytes]:
    pipeline = Pipeline(PipelineSettings(settings))
    frames = []
    for record in fly(SimulatorSettings(), duration_s=seconds).records():
        now_us = record.time_us
        for out in (pipeline.feed_record(record, now_us), pipeline.poll(now_us)):
            frames += [sent.frame for sent in out.frames]
    return frames


def test_added_message_is_sent_at_its_rate(install: Install) -> None:
    install("load_factor", example("A message"))
    assert load_extensions() == ("outputs", "load_factor")
    wanted = mavlink.MAVLINK_MSG_ID_NAMED_VALUE_FLOAT
    frames = [f for f in fly_with(AircraftSettings(), 4.0) if message_id_of(f) == wanted]
    assert 19 <= len(frames) <= 21
    message = mavlink.MAVLink(None).parse_char(frames[-1])
    assert message.name == "load"
    assert message.value == pytest.approx(1.0, abs=0.1)


def test_added_source_kind_is_a_vehicle(install: Install) -> None:
    install("beacon", example("A source"))
    load_extensions()
    (source,) = make_sources((SourceSettings(url="beacon:stdin?id=4"),), str)
    payload = struct.pack("<iih", 481000000, 115000000, 512)
    frame = b"B" + payload + bytes([sum(payload) % 256])
    pipeline = Pipeline(PipelineSettings(AircraftSettings(), sources=[source]))
    frames = []
    for number in range(20):
        data = b"?" + frame if number == 7 else frame
        frames += pipeline.feed_source(source, data, number * 500_000).frames
    wanted = mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT
    (*_, newest) = [sent.frame for sent in frames if sent.message_id == wanted]
    message = mavlink.MAVLink(None).parse_char(newest)
    assert (message.get_srcSystem(), message.lat, message.alt) == (4, 481000000, 512_000)
    assert source.report(0).faults == (("checksum", 1),)


async def test_added_endpoint_kind_sends_and_receives(install: Install, tmp_path: Path) -> None:
    install("unix_endpoint", example("An endpoint kind"))
    load_extensions()
    station = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    station.settimeout(60.0)
    station.bind(str(tmp_path / "station"))
    taken: list[Incoming] = []
    hub = Hub(HubSettings(endpoints=(), ping_interval_s=0.0), taken.append, lambda: 0)
    hub.start()
    hub.add(f"unix:{tmp_path / 'station'}?deny=RAW_IMU")
    frame = mavlink.MAVLink_attitude_message(1, 0, 0, 0, 0, 0, 0).pack(mavlink.MAVLink(None, 1, 1))
    hub.send(Outgoing(bytes(frame), mavlink.MAVLINK_MSG_ID_ATTITUDE))
    data, address = station.recvfrom(1024)
    assert message_id_of(data) == mavlink.MAVLINK_MSG_ID_ATTITUDE
    asking = mavlink.MAVLink_param_request_list_message(1, 1)
    station.sendto(bytes(asking.pack(mavlink.MAVLink(None, 255, 190))), address)
    await until(lambda: hub.clients()[0].received)
    (client,) = hub.clients()
    assert (client.state, client.sent, client.received) == ("open", 1, 1)
    hub.close()
    station.close()


def test_added_estimator_is_chosen_by_name(install: Install) -> None:
    with pytest.raises(ValueError, match="unknown estimator 'gyro_only'; choose eskf, paper"):
        EstimationSettings(estimator="gyro_only")
    install("gyro_only", example("An estimator"))
    load_extensions()
    settings = AircraftSettings(estimation=EstimationSettings(estimator="gyro_only"))
    wanted = mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION
    frames = [f for f in fly_with(settings, 2.0) if message_id_of(f) == wanted]
    first = mavlink.MAVLink(None).parse_char(frames[0])
    assert (first.q1, first.q2, first.q3, first.q4) == (1.0, 0.0, 0.0, 0.0)


def test_added_format_is_written_and_read(install: Install, tmp_path: Path) -> None:
    install("json_lines", example("A recording format"))
    load_extensions()
    settings = AircraftSettings()
    options = ReadOptions(PipelineSettings(settings))
    samples = [
        r for r in fly(SimulatorSettings(), duration_s=2.0).records() if isinstance(r, ImuRaw)
    ]
    table = tmp_path / "flight.csv"
    lines = [row_to_line(TableRow(r.time_us, raw=r)) for r in samples]
    table.write_text(encode_head(header_for(settings, 1)) + "".join(lines))
    refused = FlightToWrite([open_recording(table)], options, fusing=Fusing(wanted=True))
    written = tmp_path / "flight.jsonl"
    written.write_bytes(b"".join(WRITERS[".jsonl"](refused)))
    assert len(written.read_text().splitlines()) == len(samples)
    again = FlightToWrite([open_recording(written)], options)
    frames = [record.frame for record in again.frames()]
    assert any(message_id_of(f) == mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION for f in frames)
    assert b"".join(WRITERS[".jsonl"](again)) == written.read_bytes()


def test_added_view_is_built_on_page(install: Install, monkeypatch: pytest.MonkeyPatch) -> None:
    install("my_tracker", example("A view of the panel"))
    load_extensions()
    nicegui, context = MagicMock(), MagicMock()
    monkeypatch.setitem(sys.modules, "nicegui", nicegui)
    context.vehicle.newest = {"SYS_STATUS": MagicMock(errors_comm=7)}
    (view,) = ADDED_VIEWS.values()
    view.build(context)
    assert view.title == "Radio"
    nicegui.ui.label().classes().set_text.assert_called_with("7 samples lost")
    with pytest.raises(ValueError, match="twice"):
        add_view("Radio", "radio", "my_tracker:build")


def test_stages_run_from_python(install: Install) -> None:
    install("library", example("The stages from Python"))
    library = importlib.import_module("library")
    records = fly(SimulatorSettings(), duration_s=2.0).records()
    found = list(library.run(records))
    assert any(isinstance(item, NavState) for item in found)
    assert any(isinstance(item, bytes) and message_id_of(item) == 0 for item in found)


TAKEN = """
from gateway.estimation.select import add_estimator
from gateway.recordings.recording import open_recording

def extend():
    add_estimator("eskf", None)
"""


@pytest.mark.parametrize(
    ("source", "reason"),
    [("import no_such_package", "no_such_package"), ("", "extend"), (TAKEN, "already")],
)
def test_error_of_broken_extension_names_it(install: Install, source: str, reason: str) -> None:
    install("broken_one", source)
    with pytest.raises(ExtensionError, match=f"broken_one .*{reason}"):
        load_extensions()
