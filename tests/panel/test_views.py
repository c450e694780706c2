"""What each view shows and sends, built without a browser on the gateway's vehicle."""

import errno
import math
import os
from collections.abc import Callable, Iterator
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import pytest
from nicegui import Client, ElementFilter, ui
from nicegui.page import page
from pymavlink.dialects.v20 import all as mavlink
from starlette.requests import Request

from gateway.batch.catalogue import FlightFigures
from gateway.panel import estimator_trial
from gateway.panel.admission import LOCAL, Role
from gateway.panel.dialogues import Dialogue
from gateway.panel.estimator_trial import ComparisonError
from gateway.panel.page import PageRail, build_page, waiting_lines
from gateway.panel.player_bar import PlayerBar
from gateway.panel.state.parameters import ParameterMeta
from gateway.panel.view_context import NotAllowedError
from gateway.panel.views import recordings_view, tuning_view
from gateway.panel.views.calibration_view import CalibrationView, FieldSphere
from gateway.panel.views.events_view import EventsView, build_banner
from gateway.panel.views.flight_view import FlightMap, build_flight, build_map
from gateway.panel.views.link_view import LinkView
from gateway.panel.views.plots_view import PlotsView
from gateway.panel.views.recordings_view import RecordingsView
from gateway.panel.views.tuning_view import TuningView, range_of
from gateway.panel.widgets import DataTable, RecorderControls, RowButton, StripChart, why_not
from tests.kit.vehicle_bench import G_MPS2
from tests.panel.messages import decoded, short_tlog
from tests.panel.view_bench import ViewBench, emit, named, press, texts

GYRO_BIAS = (0.02, 0.0, 0.0)
STORAGE = mavlink.MAV_CMD_PREFLIGHT_STORAGE


@pytest.fixture(autouse=True)
def _page() -> Iterator[None]:
    scope = {"type": "http", "scheme": "http", "path": "/", "query_string": b"", "headers": []}
    with Client(page("/"), request=Request(scope | {"server": ("127.0.0.1", 14590)})):
        yield


@pytest.fixture
def bench(tmp_path: Path) -> ViewBench:
    return ViewBench(tmp_path)


@pytest.fixture
def viewer(tmp_path: Path) -> ViewBench:
    return ViewBench(tmp_path, Role.VIEWER)


def rows(table: DataTable | None = None) -> dict[str, list[str]]:
    """Return the texts of a table, by default of the newest one, by the keys of its rows."""
    shown = (table or [*ElementFilter(kind=DataTable)][-1]).props["rows"]
    return {row["key"]: [text for text, *_ in row["cells"]] for row in shown}


def value_of(bench: ViewBench, name: str) -> float:
    return bench.parts.dialogues.of(1).parameters.entries[name].value


class TestCalibration:
    def started(self, bench: ViewBench, title: str) -> None:
        """Open the view, and start a calibration once the parameters are read."""
        CalibrationView(bench.context)
        bench.fly(3.0)
        self.choose(title)
        press("Start")

    def choose(self, title: str) -> None:
        (label,) = (each for each in ElementFilter(kind=ui.label) if each.text == title)
        emit(label.parent_slot.parent.parent_slot.parent)

    def test_gyroscope_is_stored_only_after_confirmation(self, bench: ViewBench) -> None:
        self.started(bench, "Gyroscope")
        bench.fly(1.5, gyro=GYRO_BIAS)
        [progress] = ElementFilter(kind=ui.linear_progress)
        assert progress.value == pytest.approx(0.5, abs=0.1)
        bench.fly(1.7, gyro=GYRO_BIAS)
        assert any(text.startswith("Done. Measuring the remaining error") for text in texts())
        bench.fly(2.2)
        assert "Calibrated, and in use until the gateway ends. Store it?" in texts()
        shown = rows()
        before, after = (float(text) for text in shown["Rate at rest (°/s)"][1:])
        assert (before, after) == pytest.approx((math.degrees(GYRO_BIAS[0]), 0.0), abs=0.1)
        assert bench.commands == []
        press("Store it")
        assert [(each.command, each.param1) for each in bench.commands] == [(STORAGE, 1.0)]
        assert "stored" in texts()

    def test_calibration_is_undone_before_another_is_stored(self, bench: ViewBench) -> None:
        self.started(bench, "Gyroscope")
        bench.fly(1.5, gyro=GYRO_BIAS)
        # As the calibration does, which this vehicle leaves to its gateway.
        bench.parts.dialogues.of(1).change("CAL_GYRO_BIAS_X", GYRO_BIAS[0])
        bench.fly(1.7, gyro=GYRO_BIAS)
        bench.fly(2.2)
        assert any(name.endswith("(°/s), CAL_GYRO_BIAS_X") for name in rows())
        self.choose("Level")
        press("Start")
        bench.fly(3.2)
        run = bench.parts.dialogues.of(1).calibration
        assert run is not None
        assert run.step == "gyro", "the other one is neither stored nor undone"
        self.choose("Mounting")
        press("Store it")
        assert bench.commands == [], "storing would store the other too"
        self.choose("Gyroscope")
        press("Undo it")
        bench.fly()
        assert value_of(bench, "CAL_GYRO_BIAS_X") == 0.0

    def test_failed_and_cancelled_calibrations_give_the_reason(self, bench: ViewBench) -> None:
        self.started(bench, "Gyroscope")
        for n in range(40):
            bench.fly(0.1, gyro=(math.sin(n), 0.0, 0.0))
        assert "Not calibrated: it was moved. Nothing has changed; try again." in texts()
        press("Again")
        bench.fly()
        self.choose("Level")
        assert "do not touch it" in " ".join(texts()), "a running one is shown until it has ended"
        press("Cancel")
        bench.fly()
        assert "Not calibrated: cancelled. Nothing has changed; try again." in texts()

    def test_sides_and_directions_are_shown_as_they_are_done(
        self, bench: ViewBench, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        drawn: list[int] = []
        monkeypatch.setattr(FieldSphere, "show", lambda _, points, __: drawn.append(len(points)))
        self.started(bench, "Accelerometer")
        bench.fly(0.3)
        assert texts().count("hold still …") == 1
        bench.fly(2.5)
        bench.fly(2.5, accel=(0.0, 0.0, G_MPS2))
        assert (texts().count("done ✓"), texts().count("still to do")) == (2, 4)
        press("Cancel")
        bench.fly()
        self.choose("Magnetometer")
        press("Start")
        for n in range(30):
            bench.fly(0.02, mag=(40.0 * math.cos(n), 40.0 * math.sin(n), 10.0))
        assert any("directions uncovered" in text for text in texts())
        assert drawn[-1] > 10

    def test_selected_orientation_is_used_and_then_stored(self, bench: ViewBench) -> None:
        CalibrationView(bench.context)
        bench.fly(3.0)
        (choice,) = ElementFilter(kind=ui.select)
        assert choice.value == "face up, arrow to the nose"
        choice.set_value("face up, arrow to the tail")
        press("Use it")
        bench.fly()
        for sensor in ("CAL_MNT", "CAL_MAG_MNT"):
            angles = [value_of(bench, f"{sensor}_{axis}") for axis in ("ROLL", "PIT", "YAW")]
            assert angles == pytest.approx([180.0, 0.0, 180.0])
        assert ("in use" in texts(), bench.commands) == (True, [])
        press("Store it")
        assert ("stored" in texts(), len(bench.commands)) == (True, 1)

    def test_refused_storing_is_no_success(self, bench: ViewBench) -> None:
        CalibrationView(bench.context)
        bench.fly(3.0)
        bench.refusal = "the disk is full"
        press("Store it")
        assert "stored" not in texts()


class TestTuning:
    NAME = "CAL_GYRO_BIAS_Z"

    @pytest.fixture
    def field(self, bench: ViewBench) -> Any:
        """Return the field of a parameter, which the view shows in degrees."""
        TuningView(bench.context)
        bench.fly(5.0)
        named("Search", ui.input).set_value("gyroscope bias sensor")
        assert sorted(text for text in texts() if text.startswith("CAL_")) == [
            f"CAL_GYRO_BIAS_{axis}" for axis in "XYZ"
        ]
        assert "-572.96 to 572.96 °/s · default 0" in texts()
        return named(self.NAME, ui.number)

    def enter(self, field: Any, value: float) -> None:
        field.set_value(value)
        emit(field, "keydown.enter")

    def test_value_is_sent_once_finished_and_marked_while_not_the_default(
        self, bench: ViewBench, field: Any
    ) -> None:
        row = field.parent_slot.parent
        field.set_value(46.0)
        bench.fly(0.6)
        assert (value_of(bench, self.NAME), field.value) == (0.0, 46.0), "typed, and not sent yet"
        emit(field, "keydown.enter")
        field.set_value(0.0)
        bench.fly(0.6)
        assert value_of(bench, self.NAME) == pytest.approx(math.radians(46.0))
        assert ("changed" in row.classes, field.value) == (True, 0.0)
        self.enter(field, 0.0)
        bench.fly(0.6)
        assert "changed" not in row.classes
        self.enter(field, 4000.0)
        bench.fly(0.6)
        assert "the value is out of range" in texts()

    def test_previous_value_is_sent_again_while_a_change_is_unanswered(
        self, bench: ViewBench, field: Any, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        sent: list[float] = []
        monkeypatch.setattr(Dialogue, "change", lambda *given: sent.append(given[2]))
        for value in (0.0, 45.0, 45.0):
            self.enter(field, value)
        assert sent == pytest.approx([math.radians(45.0)] * 2)

    def test_typed_value_is_not_overwritten_by_its_own_answer(
        self, bench: ViewBench, field: Any
    ) -> None:
        self.enter(field, 0.8)
        bench.fly()
        assert field.value == 0.8
        number = mavlink.MAVLink_param_value_message(self.NAME.encode(), 0.01, 9, 110, 65535)
        bench.handle(decoded(number), bench.now_us())
        bench.refresh()
        assert field.value == pytest.approx(math.degrees(0.01))
        field.set_value(7.0)
        number = mavlink.MAVLink_param_value_message(self.NAME.encode(), 0.02, 9, 110, 65535)
        bench.handle(decoded(number), bench.now_us())
        bench.refresh()
        assert field.value == 7.0, "typed, and not sent yet"

    def test_list_waits_for_the_end_of_editing_and_follows_group_and_search(
        self, bench: ViewBench, field: Any
    ) -> None:
        emit(field, "focus")
        late = decoded(mavlink.MAVLink_param_value_message(b"LATE_BIAS", 1.0, 9, 111, 110))
        bench.handle(late, bench.now_us())
        named("Search", ui.input).set_value("bias")
        field = named(self.NAME, ui.number)
        named("Group", ui.select).set_value("all groups")
        emit(field, "blur")
        bench.refresh()
        assert "LATE_BIAS" in texts()
        assert "LATE" in named("Group", ui.select).options
        named("Group", ui.select).set_value("LATE")
        assert [text for text in texts() if text.endswith(("_X", "_BIAS"))] == ["LATE_BIAS"]
        press("Store all")
        assert [each.command for each in bench.commands] == [STORAGE]

    @pytest.mark.parametrize(
        ("error", "reason"),
        [
            (BrokenProcessPool("the process ended"), "the process ended"),
            (OSError(errno.ENOMEM, os.strerror(errno.ENOMEM)), "Cannot allocate memory"),
            (MemoryError(), "MemoryError"),
        ],
        ids=["process ended", "no memory", "no memory in Python"],
    )
    def test_failed_comparison_reports_the_reason_and_can_be_repeated(
        self,
        bench: ViewBench,
        monkeypatch: pytest.MonkeyPatch,
        caplog: pytest.LogCaptureFixture,
        error: Exception,
        reason: str,
    ) -> None:
        failures: list[Exception] = [error, ComparisonError("no samples")]

        async def fail(*_: Any) -> None:
            assert not named("Compare").enabled
            assert "Fusing …" in texts()
            raise failures.pop(0)

        TuningView(bench.context)
        assert named("Compare").props["title"] == "Collecting samples: 0%"
        bench.fly(8.0)
        assert any("Collecting samples: 4" in text for text in texts())
        bench.fly(14.0)
        monkeypatch.setattr(tuning_view, "compare_apart", fail)
        for text in (reason, "no samples"):
            press("Compare")
            assert f"Cannot be compared: {text}." in texts()
        assert named("Compare").enabled
        assert [record.exc_info[1] for record in caplog.records if record.exc_info] == [error]

    def test_estimators_are_compared_with_the_flight(
        self, bench: ViewBench, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        async def compare(frames: Any, values: Any) -> Any:
            return estimator_trial.compare(frames, values)

        monkeypatch.setattr(tuning_view, "compare_apart", compare)
        TuningView(bench.context)
        bench.fly(23.0, mag=(20.0, 0.0, 40.0))
        press("Compare")
        assert [row[0] for row in rows().values()] == ["eskf", "paper"]
        assert all(row[1].endswith(" °") for row in rows().values())

    def test_metadata_without_parameters_is_parsed_once(
        self, bench: ViewBench, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """It would be parsed again with each message, which takes long for a large one."""
        parsed: list[bytes] = []

        def parse(content: bytes) -> dict[str, ParameterMeta]:
            parsed.append(content)
            return {}

        monkeypatch.setattr("gateway.panel.state.parameters.parse_parameters", parse)
        dialogue = bench.parts.dialogues.of(1)
        for count in (1, 2):
            dialogue.load(again=True)
            bench.fly(10.0)
            assert len(parsed) == count

    def test_range_of_a_parameter_has_units_and_open_ends(self) -> None:
        meta = ParameterMeta(name=self.NAME, unit="rad/s", low=-10.0, high=10.0, default=0.0)
        assert range_of(meta) == "-572.96 to 572.96 °/s · default 0"
        assert range_of(ParameterMeta(name=self.NAME, unit="m", low=0.0)) == "0 to any m"


@pytest.fixture
def called(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
    """Return the calls of the browser's strip charts, each by method and arguments."""
    calls: list[tuple[Any, ...]] = []
    answers = {"range": [0.0, 1e15], "picture": "data:image/png;base64,AAAA"}

    async def answer(name: str) -> object:
        return answers[name]

    def run(_: Any, name: str, *given: Any, timeout: float = 1.0) -> Any:
        calls.append((name, *given, timeout))
        return answer(name) if name in answers else None

    monkeypatch.setattr(StripChart, "run_method", run)
    return calls


def test_fields_are_plotted_paused_and_saved(
    bench: ViewBench, called: list[tuple[Any, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    saved: list[tuple[str, bytes | str]] = []
    monkeypatch.setattr(ui.download, "content", lambda data, name, _: saved.append((name, data)))
    PlotsView(bench.context)
    bench.fly(1.0)
    charts = [*ElementFilter(kind=StripChart)]
    for chart in charts:
        emit(chart, "ready")
    bench.fly(1.0)
    (begun,) = (each for each in called if each[0] == "set_fields" and "roll" in str(each))
    assert begun[1] == [
        {"name": "ATTITUDE.roll", "unit": "°"}, {"name": "ATTITUDE.pitch", "unit": "°"}
    ]  # fmt: skip
    (times, values), _ = next(each for each in called if each[0] == "append")[1]
    assert len(times) == len(values) > 20
    press("Pause")
    emit(charts[0], "paused")
    assert [each[1] for each in called if each[0] == "pause"] == [True] * 4
    press("Resume")
    press("Save as CSV")
    press("Save as PNG")
    (_, table), (_, picture) = saved
    assert str(table).startswith("time_unix_s,VFR_HUD.alt (m),VFR_HUD.climb (m/s)\n")
    assert len(str(table).splitlines()) > 10
    assert picture == b"\0\0\0"
    limits_s = [each[-1] for each in called if each[0] in ("range", "picture")]
    assert min(limits_s) >= 60.0, "drawing takes longer than other answers"
    for _ in range(9):
        press("Add a chart")
    assert len([*ElementFilter(kind=StripChart)]) == 8
    press("Remove this chart")
    assert len([*ElementFilter(kind=StripChart)]) == 7


AT = {"lat_deg": 47.1, "lon_deg": 8.2}


class TestMap:
    def of(self, bench: ViewBench) -> FlightMap:
        build_map(bench.context)
        bench.fly(1.0)
        (found,) = ElementFilter(kind=FlightMap)
        return found

    def sent(self, bench: ViewBench) -> list[tuple[int, int]]:
        return [(each.command, each.x) for each in bench.commands if hasattr(each, "x")]

    def test_mark_is_shown_once_acknowledged_and_cleared(self, bench: ViewBench) -> None:
        view, vehicle = self.of(bench), bench.context.vehicle
        assert vehicle is not None
        bench.refusal = "denied"
        emit(view, "mark", AT)
        assert vehicle.exact_mark is None
        bench.refusal = ""
        emit(view, "mark", AT)
        assert vehicle.exact_mark is not None
        assert vehicle.exact_mark.lat_deg == AT["lat_deg"]
        assert self.sent(bench) == [(mavlink.MAV_CMD_DO_SET_ROI_LOCATION, 471_000_000)]
        emit(view, "clear", AT)
        assert (vehicle.exact_mark, len(bench.commands)) == (None, 2)

    def test_home_is_set_only_after_confirmation(self, bench: ViewBench) -> None:
        emit(self.of(bench), "home", AT)
        assert "Set home of Plane 1 to 47.100000, 8.200000?" in texts()
        assert bench.commands == []
        press("Set home")
        assert self.sent(bench) == [(mavlink.MAV_CMD_DO_SET_HOME, 471_000_000)]


def status(**changed: Any) -> dict[str, Any]:
    """Return the status of a gateway with a node, a source, a client and a port."""
    node = {"vehicle_id": 1, "node_id": 1}
    counts = {"received": 90, "lost": 10, "restarts": 1, "rate_hz": 50.0, "clock_skew_ppm": 3.0}
    source = {"url": "crsf:/dev/ttyS1", "connected": False, "reason": "unplugged", "records": 5}
    client = {"client_id": 4, "name": "udp:10.0.0.9:14550", "state": "open", "reason": "",
              "sent": 100, "dropped": 0, "received": 7, "round_trip_us": 1500, "heard_us": None,
              "trusted": False, "receives": True}  # fmt: skip
    report = {
        "time_us": 9_000_000, "port": "/dev/ttyUSB0", "connected": True, "frames": 1,
        "bytes_received": 64, "frames_lost": 2, "faults": [("crc", 3)],
        "receiver": {"channel": 76, "noise_percent": 4, "radio": 0},
        "nodes": [{"node": node, "last_time_us": 8_900_000, "signal": None, **counts}],
        "sources": [{**source, "last_time_us": None, "faults": [], "node": node}],
    }  # fmt: skip
    boards = [{"node": node, "sensors_present": 8, "chips": ["NEO-7M"]}]
    return {
        "time_us": 9_000_000, "report": report | changed, "simulated": False, "clients": [client],
        "aircraft": [{"vehicle_id": 1, "boards": boards, "troubles": {}}], "recorder": None,
        "listeners": [{"name": "udp-listen:14550", "reason": "", "state": "open", "clients": 1,
                       "turned_away": 2}],
    }  # fmt: skip


SERIAL = {
    "is_fixed": False, "wanted": "auto", "state": "open", "device": "/dev/ttyUSB0",
    "reason": "", "ports": [{"device": "/dev/ttyUSB0", "description": "CH340"}],
}  # fmt: skip


class TestLink:
    @pytest.fixture
    def view(self, bench: ViewBench) -> LinkView:
        bench.parts.watch.status = status()
        bench.answers = {"serial.status": SERIAL, "source.tokens": {"a" * 16: "phone"}}
        made = LinkView(bench.context)
        bench.fly(0.5)
        return made

    def test_receiver_nodes_sources_clients_and_vehicles_are_shown(self, view: LinkView) -> None:
        assert (
            "/dev/ttyUSB0 connected · 1 frame, 2 lost on the line · channel 76, noise 4 % · "
            "3 crc faults"
        ) in texts()
        nodes, sources, clients, ports, vehicles = ElementFilter(kind=DataTable)
        assert rows(nodes)["1.1"][:5] == ["1 GPS", "50 Hz", "90", "10", "10.00 %"]
        assert rows(sources)["crsf:/dev/ttyS1"] == [
            "crsf:/dev/ttyS1",
            "unplugged",
            "5",
            "—",
            "none",
        ]
        assert rows(clients)["udp:10.0.0.9:14550"][1:] == [
            "open", "100", "—", "0", "7", "1.5 ms", "never", "may look"
        ]  # fmt: skip
        assert rows(ports)["udp-listen:14550"] == ["udp-listen:14550", "open", "1", "2"]
        assert rows(vehicles)["1"][0] == "Plane 1"
        assert f"phone: http://127.0.0.1:14590/push/{'a' * 16}" in texts()

    def test_client_is_added_and_removed_after_confirmation(
        self, bench: ViewBench, view: LinkView
    ) -> None:
        field = named("Endpoint of a new client or source", ui.input)
        field.set_value(" udp:10.0.0.9:1 ")
        press("Add")
        assert field.value == " udp:10.0.0.9:1 ", "it is refused"
        bench.answers |= dict.fromkeys(("clients.add", "clients.remove"))
        bench.answers["status"] = status() | {"aircraft": []}
        press("Add")
        assert field.value == ""
        table = [*ElementFilter(kind=DataTable)][2]
        emit(table, "act", [0, "udp:10.0.0.9:14550"])
        assert bench.asked[-1][0] != "clients.remove"
        press("Remove")
        asked = [each for each in bench.asked if each[0].startswith("clients.")]
        added = ("clients.add", {"url": "udp:10.0.0.9:1"})
        assert asked == [added, added, ("clients.remove", {"name": "udp:10.0.0.9:14550"})]

    def test_serial_port_is_disconnected_and_another_connected(
        self, bench: ViewBench, view: LinkView
    ) -> None:
        assert "/dev/ttyUSB0 is open, until the gateway ends or another is connected" in texts()
        bench.answers |= {
            "serial.disconnect": SERIAL | {"state": "closed"},
            "serial.connect": SERIAL, "status": status() | {"aircraft": []},
        }  # fmt: skip
        press("Disconnect")
        assert "disconnected: no data until a port is connected" in texts()
        assert named("Disconnect").props["title"] == "No port is connected."
        named("Serial port", ui.select).set_value("/dev/ttyUSB0")
        press("Connect")
        assert ("serial.connect", {"port": "/dev/ttyUSB0"}) in bench.asked

    def test_ended_gateway_leaves_no_rows(self, bench: ViewBench, view: LinkView) -> None:
        bench.parts.watch.status = None
        bench.refresh()
        assert "No gateway runs on this machine." in texts()
        assert [len(rows(table)) for table in ElementFilter(kind=DataTable)] == [0, 0, 0, 0, 1]


RECORDER = {
    "folder": ".", "state": "idle", "reason": "", "name": "day", "part_bytes": 0,
    "free_bytes": 10**9,
}  # fmt: skip


class TestRecordings:
    @pytest.fixture
    def recorder(self, bench: ViewBench, tmp_path: Path) -> dict[str, Any]:
        bench.parts.watch.recorder = RECORDER | {"folder": str(tmp_path)}
        return bench.parts.watch.recorder

    @pytest.mark.parametrize(
        ("state", "name", "allowed"),
        [
            ("idle", "", {"start"}),
            ("idle", "day", {"start", "save", "delete"}),
            ("recording", "day", {"stop", "save"}),
            ("opening", "day", {"stop", "save"}),
            ("blocked", "day", {"start", "stop", "save"}),
        ],
        ids=["new", "stopped", "recording", "opening", "blocked"],
    )
    def test_recorder_offers_only_what_it_can_do(
        self, state: str, name: str, allowed: set[str]
    ) -> None:
        verbs = ("start", "stop", "save", "delete")
        recorder = {"state": state, "name": name}
        assert {verb for verb in verbs if not why_not(verb, recorder)} == allowed

    def test_recorder_is_started_its_recording_named_and_deleted(
        self, bench: ViewBench, recorder: dict[str, Any]
    ) -> None:
        RecorderControls(bench.context)
        assert named("Stop recording").props["title"] == "Nothing is being recorded."
        bench.answers = dict.fromkeys(("record.start", "record.rename", "record.delete"))
        bench.answers |= {"record.list": [{"name": "day"}], "status": status(recorder=recorder)}
        bench.answers["status"]["recorder"] = recorder
        press("Start recording")
        press("Save recording")
        named("Name of the recording", ui.input).set_value(" morning ")
        press("Save")
        press("Delete recording")
        assert "Delete the last recording, day, permanently?" in texts()
        press("Delete")
        changes = [each for each in bench.asked if each[0] not in ("status", "record.list")]
        assert changes == [
            ("record.start", {}), ("record.rename", {"name": "morning"}),
            ("record.delete", {"name": "day"}),
        ]  # fmt: skip

    @pytest.fixture
    def view(self, bench: ViewBench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> DataTable:
        for name in ("day", "night"):
            (tmp_path / f"{name}_01.tlog").write_bytes(short_tlog())
        monkeypatch.setattr(bench.parts.jobs, "index", lambda *_: None)
        monkeypatch.setattr(bench.parts.pages, "holder", lambda _: LOCAL)
        RecordingsView(bench.context)
        bench.refresh()
        return [*ElementFilter(kind=DataTable)][-1]

    def act(self, view: DataTable, title: str, key: str = "day") -> None:
        number = next(n for n, (_, each) in enumerate(view.props["buttons"]) if each == title)
        emit(view, "act", [number, key])

    def test_recordings_are_listed_searched_and_deleted(
        self, bench: ViewBench, view: DataTable, tmp_path: Path
    ) -> None:
        assert {name: row[3] for name, row in rows(view).items()} == {
            "day": "1 tlog", "night": "1 tlog",
        }  # fmt: skip
        named("Search recordings", ui.input).set_value("NIG")
        bench.refresh()
        assert [*rows(view)] == ["night"]
        self.act(view, "Delete", "night")
        assert (tmp_path / "night_01.tlog").exists()
        press("Delete")
        assert not (tmp_path / "night_01.tlog").exists()

    def test_part_of_a_recording_is_ordered_with_its_options(
        self, bench: ViewBench, view: DataTable, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        orders: list[tuple[str, tuple[str, ...]]] = []
        fetched: list[str] = []

        async def export(order: Any, _: Any) -> str:
            orders.append((order.kind, order.options))
            return "/exports/token"

        monkeypatch.setattr(bench.parts.jobs, "export", export)
        monkeypatch.setattr(ui.download, "from_url", fetched.append)
        self.act(view, "Export")
        press("KML (Google Earth)")
        for label, value, button in (
            ("From", "soon", "Cut to a tlog"),
            ("To", "1.5", "Anonymised tlog"),
            ("Vehicle", 1, "Parameters"),
        ):
            self.act(view, "Cut or extract")
            named(label, ui.number if label == "Vehicle" else ui.input).set_value(value)
            press(button)
        assert orders == [("kml", ()), ("anonymised", ("--to=1.5",)), ("params", ("--system=1",))]
        self.act(view, "Download")
        assert fetched == ["/exports/token"] * 3 + ["/recordings/day"]

    def test_unknown_figures_of_a_recording_are_dashes(self) -> None:
        cells = recordings_view._facts_cells
        assert cells(FlightFigures(61.2)) == ("0:01:01", "—", "—", ("—", ""))
        known = FlightFigures(3601.0, distance=math.nan, highest=7.4, height_above="home", loss=0.1)
        assert cells(known) == ("1:00:01", "—", "7 m above home", ("10.0%", "warn"))

    def test_player_shows_and_orders_its_state(self, bench: ViewBench) -> None:
        ordered: list[tuple[str, dict[str, Any]]] = []

        async def order(verb: str, **params: Any) -> None:
            ordered.append((verb, params))

        playback: Any = bench.playback
        playback.order, playback.name = order, "day"
        PlayerBar(bench.context)
        playback.status = {"state": "playing", "speed": 2, "duration_s": 9.0, "position_s": 3.0}
        [timer] = ElementFilter(kind=ui.timer)
        timer.callback()
        assert named("Speed", ui.select).value == 2
        assert ordered == [], "showing the player's state orders nothing"
        press("Ahead ten seconds")
        named("Speed", ui.select).set_value(10)
        press("Close the playback")
        assert ordered[0] == ("seek", {"to": "+10"})
        assert playback.status is None


class TestEvents:
    def test_texts_are_filtered_by_severity_and_words(
        self, bench: ViewBench, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        saved: list[str] = []
        monkeypatch.setattr(ui.download, "content", lambda data, *_: saved.append(data))
        EventsView(bench.context)
        bench.fly()
        for severity, text in ((6, b"all is well"), (2, b'a "crash"'), (4, b"low supply")):
            message = mavlink.MAVLink_statustext_message(severity, text)
            bench.handle(decoded(message), bench.now_us())
        bench.refresh()
        found = {row[2]: row[1] for row in rows().values()}
        assert found["low supply"] == "Warning"
        named("Severity", ui.select).set_value(2)
        assert [row[1:] for row in rows().values()] == [["Critical", 'a "crash"']]
        named("Severity", ui.select).set_value(7)
        named("Search in the texts", ui.input).set_value("WELL")
        assert [row[2] for row in rows().values()] == ["all is well"]
        named("Search in the texts", ui.input).set_value("crash")
        press("Save as CSV")
        assert saved[0].endswith(',Critical,"a ""crash"""\n')

    def test_banner_stands_while_a_problem_of_a_live_vehicle_lasts(self, bench: ViewBench) -> None:
        build_banner(bench.context)
        [timer] = ElementFilter(kind=ui.timer)
        bench.fly()
        bench.parts.watch.status = status()
        bench.parts.watch.status["aircraft"][0]["troubles"] = {"link": "Receiver lost: /dev/ttyS0"}
        timer.callback()
        assert texts() == ["Receiver lost: /dev/ttyS0", ""]
        vehicle = bench.context.vehicle
        assert vehicle is not None
        vehicle.origin = "recorded"
        timer.callback()
        assert texts() == []


VIEWS: dict[str, Callable[[Any], object]] = {
    "map": build_map, "flight": build_flight, "link": LinkView, "recordings": RecordingsView,
    "calibration": CalibrationView, "tuning": TuningView, "plots": PlotsView, "events": EventsView,
}  # fmt: skip


@pytest.mark.parametrize("name", VIEWS)
@pytest.mark.usefixtures("called")
def test_viewer_is_offered_and_allowed_no_change(viewer: ViewBench, name: str) -> None:
    VIEWS[name](viewer.context)
    viewer.fly(3.0)
    changing = {"Start recording", "Delete recording", "Add", "Connect", "Add map…"}
    shown = {each.props.get("aria-label") or each.text for each in ElementFilter(kind=ui.button)}
    assert not shown & changing
    for button in [*ElementFilter(kind=ui.button)]:
        # A request that a page hides can be sent all the same.
        button.set_enabled(True)
        emit(button)
    for map_view in ElementFilter(kind=FlightMap):
        assert not map_view.props["may_mark"]
        emit(map_view, "mark", AT)
    for row in ElementFilter(kind=ui.number):
        assert not row.enabled
    assert viewer.commands == []
    assert all(verb.endswith((".status", ".list")) for verb, _ in viewer.asked)


async def test_viewer_may_only_ask_for_what_changes_nothing(viewer: ViewBench) -> None:
    viewer.answers = {"status": 1}
    assert await viewer.context.ask("status") == 1
    for verb in ("clients.add", "record.start", "source.tokens", "serial.connect"):
        with pytest.raises(NotAllowedError):
            await viewer.context.ask(verb)
    with pytest.raises(NotAllowedError):
        await viewer.context.command(STORAGE, 1.0)


class TestPage:
    def chips(self) -> set[str]:
        return {each.text for each in ElementFilter(kind=ui.label) if "chip" in each.classes}

    def test_header_shows_vehicle_source_and_state(self, bench: ViewBench) -> None:
        build_page(bench.parts, Role.VIEWER)
        timers = [each for each in ElementFilter(kind=ui.timer) if each.interval == 0.5]
        assert (
            "No aircraft yet, and no gateway runs on this machine: start `mavgate run`." in texts()
        )
        bench.fly(1.0)
        bench.parts.watch.status = status() | {"simulated": True}
        bench.parts.watch.recorder = RECORDER | {"state": "recording"}
        for timer in timers:
            timer.callback()
        assert named("Aircraft", ui.select).options == {1: "Plane 1"}
        assert self.chips() >= {"viewer", "link", "simulation", "no GPS fix", "● REC"}
        bench.vehicle.now_us += 4_000_000
        for timer in timers:
            timer.callback()
        assert "silent for 5 s" in self.chips()
        (rail,) = ElementFilter(kind=PageRail)
        assert [view["key"] for view in rail.props["views"]][:2] == ["flight", "map"]
        emit(rail, "show", "events")
        assert "No texts yet." in [t.props["empty"] for t in ElementFilter(kind=DataTable)]

    def test_waiting_lines_name_what_is_configured_and_received(self) -> None:
        _, configured, received = waiting_lines(status())
        parts = ("source crsf:/dev/ttyS1", "listening on udp-listen:14550")
        assert configured == f"Configured: receiver: /dev/ttyUSB0 connected; {'; '.join(parts)}."
        counts = ("1 frame of receiver", "5 records of crsf:/dev/ttyS1")
        assert received == f"Received: {'; '.join(counts)}; 7 frames of udp:10.0.0.9:14550."


class TestTable:
    def test_button_of_a_row_acts_only_while_the_row_is_shown(self) -> None:
        pressed: list[str] = []
        buttons = [RowButton("close", "Remove", pressed.append)]
        table = DataTable(("Name",), "None.", buttons=buttons)
        table.show({"b": (("1", ""),), "d": (("2", "bad", "error"),)})
        assert table.props["rows"] == [
            {"key": "b", "cells": [["1", ""]]},
            {"key": "d", "cells": [["2", "bad", "error"]]},
        ]
        for key in ("d", "gone"):
            emit(table, "act", [0, key])
        assert pressed == ["d"]

    def test_control_characters_are_escaped_except_in_keys(self) -> None:
        table = DataTable(("Name",))
        table.show({"a\x1b[2J": (("a\x1b[2J", ""),)})
        assert table.props["rows"] == [{"key": "a\x1b[2J", "cells": [["a\\x1b[2J", ""]]}]
