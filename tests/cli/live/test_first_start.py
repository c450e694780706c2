"""`mavgate setup`: the guidance on the simulated receiver, and when something is missing."""

import os
import select
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest

from gateway.cli.live import calibrate, first_start
from gateway.cli.support import phone
from gateway.clock import GatewayClock
from gateway.config import load, load_aircraft
from gateway.live.pty_port import PtyPort
from gateway.live.serial_port import SerialPort
from gateway.panel.logins import matches
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.simulator.timed_frame import TimedFrame
from gateway.simulator.trajectory import Workbench
from tests.kit.cli import invoke

pytestmark = pytest.mark.io


SPEED = 8.0
"""The simulated receiver and the gateway clock run so many times faster than true time."""


class FastClock(GatewayClock):
    def __call__(self) -> int:
        return round(SPEED * super().__call__())


def fast_port(frames: Iterator[TimedFrame]) -> PtyPort:
    return PtyPort(TimedFrame(frame.time_s / SPEED, frame.data) for frame in frames)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calibrate, "GatewayClock", FastClock)
    monkeypatch.setattr(calibrate, "PtyPort", fast_port)
    monkeypatch.setattr(first_start, "GPS_WAIT_S", 0.5)


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "gateway.toml"
    path.write_text(f'aircraft_folder = "{tmp_path}"\n')
    return path


def setup(*words: object, code: int = 0) -> str:
    return invoke("setup", *words, answers="\n" * 20, code=code).output


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_every_step_passes_on_the_simulated_receiver_and_saves_nothing(config: Path) -> None:
    output = setup("--simulated", "--config", config)
    for text in ("channel 76", "MPU6050, HMC5883L, BMP180", "5 of 6 sides are done"):
        assert text in output
    for step in ("gyro", "accel", "level", "mag"):
        assert f"{step}: done" in output
    ending = output[output.index("5 of 5") :]
    assert "not saved: the receiver is simulated" in ending
    assert "Done" in ending
    assert load_aircraft(load(config)) == {}


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_calibrate_command_runs_on_the_simulated_receiver_and_saves_nothing(config: Path) -> None:
    words = ("calibrate", "mounting", "gyro", "--simulated", "--vehicle", "2", "--config", config)
    done = invoke(*words, answers="\n" * 3, code=0)
    assert "mounting: done" in done.output
    assert "gyro_bias, °/s" in done.output
    assert load_aircraft(load(config)) == {}


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_calibration_of_a_receiver_at_a_port_is_saved(
    config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(first_start, "STEPS", (calibrate.Step.GYRO,))
    with calibrate.simulated_receiver(SimulatorSettings(vehicle_id=3)) as (path, _):
        wrong = setup("--port", path, "--vehicle", "4", "--config", config, code=2)
        setup("--port", path, "--config", config)
    assert "nothing is received from vehicle 4, but from 3" in wrong
    assert load_aircraft(load(config))[3].calibration.gyro_residual_radps > 0.0


@pytest.mark.parametrize(
    ("is_simulated", "last"), [(False, "nothing to save"), (True, "not saved")]
)
def test_end_without_a_successful_step_names_what_was_saved(
    config: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
    is_simulated: bool, last: str,
) -> None:  # fmt: skip
    for name in ("capture_from", "calibrate_each"):
        monkeypatch.setattr(first_start, name, lambda *_: None)
    settings, bench = load(config), Workbench(SimulatorSettings()) if is_simulated else None
    assert first_start._calibrate(settings, settings.serial, 1, bench) == 0
    assert last in capsys.readouterr().out


@pytest.fixture
def terminal() -> Iterator[tuple[int, str]]:
    master, slave = os.openpty()
    tty.setraw(slave)
    yield master, os.ttyname(slave)
    os.close(master)
    os.close(slave)


@pytest.mark.parametrize(
    ("sent", "said"),
    [(b"", "sends nothing"), (b"\x01\x02\x00" * 9, "sends bytes that are not frames")],
    ids=["nothing", "garbage"],
)
def test_port_that_is_no_receiver_is_named_with_what_to_do(
    terminal: tuple[int, str], sent: bytes, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    master, path = terminal
    monkeypatch.setattr(first_start, "LOOK_S", 0.3)
    before = SerialPort.start

    def start(port: SerialPort) -> None:
        before(port)
        os.write(master, sent)
        if sent:
            assert select.select([port._port], [], [], 60.0)[0], "there before the look begins"

    monkeypatch.setattr(SerialPort, "start", start)
    output = setup("--port", path, code=2)
    assert f"{path} {said}" in output
    assert f"mavgate flash --show --port {path}" in output


def test_missing_port_ends_with_what_to_do(tmp_path: Path) -> None:
    assert "mavgate flash receiver" in setup("--port", tmp_path / "none", code=2)


def test_phone_gets_an_address_a_password_and_a_url_that_stay(
    config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(phone, "own_address", lambda: "192.168.1.20")
    config.write_text(f'# mine\n{config.read_text()}\n[[sources]]\nurl = "crsf:stdin"\n')
    words = ("setup", "phone", "-c", config)
    assert "Aborted" in invoke(*words, answers="tower\ntower\nn\n", code=1).output
    assert load(config).panel.password == ""
    first = invoke(*words, answers="tower\ntower\ny\n", code=0).output
    settings = load(config)
    assert (settings.panel.enabled, settings.panel.insecure) == (True, True)
    assert matches("tower", settings.panel.password)
    crsf, pushed = (source.url for source in settings.sources)
    token = pushed.removeprefix("phone:push?token=")
    assert (crsf, len(token)) == ("crsf:stdin", 32)
    assert f"\nhttp://192.168.1.20:14590/push/{token}\n" in first
    assert "\u2580" in first, "the QR code"
    assert config.read_text().startswith("# mine")
    # A second time nothing is asked or changed.
    before = config.read_bytes()
    assert token in invoke(*words, code=0).output
    assert config.read_bytes() == before
