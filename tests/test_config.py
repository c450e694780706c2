"""The settings file: strict in, documented out; hostile TOML is refused in a moment."""

import itertools
import os
import re
import stat
import time
from pathlib import Path

import msgspec
import pytest

from gateway.config import (
    MAX_ERRORS,
    USUAL,
    ConfigError,
    GatewaySettings,
    aircraft_file,
    exposed_secrets,
    load,
    load_aircraft,
    render,
    save_aircraft,
    save_endpoint,
)
from gateway.estimation.select import EstimationSettings
from gateway.hub.settings import HubSettings
from gateway.recordings.files import FlightError
from gateway.recordings.reading import read_column_map
from gateway.sensing.calibration import NodeCalibration
from gateway.settings import Field, Settings, fields_of
from gateway.toml_file import MAX_BYTES, MAX_DEPTH, TomlError, read_toml
from gateway.vehicle.vehicle_settings import VehicleSettings
from tests.conftest import ROOT


def all_fields(kind: type[Settings], prefix: str = "") -> list[tuple[str, Field]]:
    found = []
    for field in fields_of(kind):
        if field.section:
            found += all_fields(field.section, f"{prefix}{field.name}.")
        else:
            found.append((f"{prefix}{field.name}", field))
    return found


FIELDS = all_fields(GatewaySettings)


def test_documented_file_and_template_contain_defaults(tmp_path: Path) -> None:
    """config/gateway.toml shows every setting; `mavgate doctor --template all` prints it."""
    assert (ROOT / "config" / "gateway.toml").read_text() == render(GatewaySettings())
    assert load(ROOT / "config" / "gateway.toml") == GatewaySettings()
    text = render(GatewaySettings(), USUAL)
    assert {*USUAL} <= {path for path, _ in FIELDS}
    assert len(re.findall(r"^\w+ = ", text, re.MULTILINE)) == len(USUAL) == 15
    assert load_text(tmp_path, text) == GatewaySettings()


def test_every_setting_is_explained() -> None:
    suffixes = {"_hz": "Hz", "_s": "s", "_m": "m", "_mps": "m/s", "_deg": "deg", "_us": "us"}
    for path, field in FIELDS:
        assert len(field.meaning) > 10, path
        number = isinstance(field.default, int | float) and not isinstance(field.default, bool)
        for suffix, unit in suffixes.items():
            if number and path.endswith(suffix):
                assert field.unit == unit, path


def load_text(folder: Path, text: str) -> GatewaySettings:
    file = folder / "gateway.toml"
    file.write_text(text)
    return load(file)


def errors_in(folder: Path, text: str) -> list[str]:
    """Return the errors in a settings file, without its name."""
    with pytest.raises(ConfigError) as caught:
        load_text(folder, text)
    lines = str(caught.value).splitlines()
    assert all(line.startswith(f"{folder / 'gateway.toml'}: ") for line in lines)
    return [line.removeprefix(f"{folder / 'gateway.toml'}: ") for line in lines]


def test_empty_file_gives_defaults_and_changed_settings_survive_the_round_trip(
    tmp_path: Path,
) -> None:
    settings = GatewaySettings()
    for text in ("", "\ufeff[serial]\n"):
        assert load_text(tmp_path, text) == settings, text
    serial = msgspec.structs.replace(settings.serial, port="usb:1a86:7523", baud=1_000_000)
    rates = msgspec.structs.replace(settings.vehicle.rates, attitude_hz=12.5)
    vehicle = msgspec.structs.replace(settings.vehicle, rates=rates, type="quadrotor")
    settings = msgspec.structs.replace(settings, serial=serial, vehicle=vehicle)
    assert load_text(tmp_path, render(settings)) == settings


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[serial]\nbaud = 300", "serial.baud = 300: must be 9600 to 2000000 baud (speed of"),
        ('[serial]\nbaud = "fast"', 'serial.baud = "fast": must be 9600 to 2000000 baud'),
        ("[serial]\nbauds = 9600", "serial.bauds: no such setting; did you mean 'baud'?"),
        ("[serial]\nzzz = 1", "serial.zzz: no such setting; known here: port, baud"),
        ("[serail]", "serail: no such setting; did you mean 'serial'?"),
        ("serial = 3", "serial = 3: must be"),
        ('[serial]\nport = "ttyUSB0"', 'serial.port = "ttyUSB0": must be as described'),
        ("[vehicle.rates]\nattitude_hz = -1", "attitude_hz = -1: must be 0 to 1000 Hz (ATTITUDE"),
        ('[vehicle]\ntype = "ufo"', 'vehicle.type = "ufo": must be one of the choices'),
        ('[hub]\nendpoints = ["udp:"]', "hub: endpoint 'udp:'"),
        ('[hub]\nendpoints = ["udp:127.0.0.1:0"]', "port must be 1 to 65535"),
        ('[hub]\nendpoints = ["serial::57600"]', "write serial:DEVICE:BAUD"),
        ('[hub]\nendpoints = ["udp-multicast:127.0.0.1:14550"]', "is not a multicast group"),
        ('[recording]\nfolder = "~no-such-user/x"', "no user has the home ~no-such-user"),
        ('aircraft_folder = "~no-such-user"', "write the whole path"),
        (f"[serial]\nbaud = {'9' * 5000}", "is not valid TOML: Exceeds the limit"),
        (r'aircraft_folder = "/tmp/\u0000"', r"aircraft_folder = '/tmp/\x00': a path"),
        ('[vehicle]\nsupply_low_v = "x"', 'vehicle.supply_low_v = "x": must be 0 to 12 V'),
        ("[panel]\nenabled = 1", "panel.enabled = 1: must be true or false"),
        ('[hub]\nendpoints = "udp:1"', "must be a list in brackets"),
        ("[panel]\nhosts = [1]", "must be a list, each entry a text in quotes"),
        ("[simulator]\ngps_outages_s = [[1]]", "each entry a list in brackets of 2 entries"),
        ('[recording]\nmode = "never"', "allowed: manual, in_flight, armed, always"),
        ('[serial]\nport = "x"', "must be as described (port of the receiver"),
        ('[hub]\nendpoints = ["192.168.1.20"]', "write udp:192.168.1.20:14550"),
        ('[hub]\nendpoints = ["udp:1.2.3.4:5?trust=no"]', "did you mean 'trusted'?"),
        ('[estimation.paper]\naccel_filter = "chebishev"', "mean 'chebyshev'? allowed: butterw"),
    ],
    ids=lambda text: text.partition(" = ")[0].replace("\n", " "),
)
def test_error_names_file_key_value_and_allowed_values_in_words(
    text: str, message: str, tmp_path: Path
) -> None:
    errors = "\n".join(errors_in(tmp_path, text))
    assert message in errors
    assert not re.search("expected|`|regex|enum", errors.partition(" (")[0].lower())


def test_all_errors_are_reported_at_once(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        load(tmp_path / "missing.toml")
    urls = ["udp:", "tcp:host:99999", "udp:127.0.0.1:14550", "udp:127.0.0.1:14550?name=b"]
    hub = f"[hub]\nmax_clients = 0\nendpoints = {urls}\n"
    lines = errors_in(tmp_path, f"{hub}[serial]\nbaud = 1\nport = 2\n[vehicle]\nnope = 3\n")
    errors = ("'udp:'", "99999", "is given twice", "serial.baud", "serial.port", "vehicle.nope")
    assert len(lines) == 7
    for words in ("max_clients", *errors):
        assert sum(words in line for line in lines) == 1


@pytest.fixture
def settings(tmp_path: Path) -> GatewaySettings:
    return GatewaySettings(aircraft_folder=str(tmp_path / "aircraft"))


def test_aircraft_file_overrides_common_settings(settings: GatewaySettings) -> None:
    estimation = msgspec.convert({"paper": {"accel_cutoff_hz": 7.0}}, EstimationSettings)
    settings = msgspec.structs.replace(settings, estimation=estimation)
    assert load_aircraft(settings) == {}
    (folder := Path(settings.aircraft_folder)).mkdir()
    (folder / "3.toml").write_text(
        '[vehicle]\ntype = "quadrotor"\n[calibration]\ngyro_bias_radps = [0.1, 0.0, -0.1]\n'
        '[estimation.paper]\naccel_filter = "chebyshev"\n'
    )
    (folder / "99.toml").write_text("nonsense")
    found = load_aircraft(settings)
    assert list(found) == [3]
    assert found[3].calibration.gyro_bias_radps == (0.1, 0.0, -0.1)
    assert found[3].vehicle.type == "quadrotor"
    paper = found[3].estimation.paper
    assert (paper.accel_cutoff_hz, paper.accel_filter) == (7.0, "chebyshev")


def test_invalid_aircraft_files_are_reported(settings: GatewaySettings) -> None:
    (folder := Path(settings.aircraft_folder)).mkdir()
    (folder / "1.toml").write_text("[calibration]\nbias = 3\n")
    (folder / "2.toml").write_text("[calibration\n")
    with pytest.raises(ConfigError) as caught:
        load_aircraft(settings)
    first, second = str(caught.value).splitlines()
    assert "1.toml: calibration.bias: no such setting" in first
    assert "2.toml: is not valid TOML" in second


def test_only_changed_settings_are_saved_and_comments_kept(settings: GatewaySettings) -> None:
    file = aircraft_file(settings, 2)
    file.parent.mkdir()
    file.write_text("# my plane\n[estimation.paper]\naccel_cutoff_hz = 4.0 # slow\n")
    aircraft = load_aircraft(settings)[2]
    calibration = NodeCalibration(accel_bias_mps2=(0.1, 0.2, 0.3))
    aircraft = msgspec.structs.replace(aircraft, calibration=calibration)
    assert save_aircraft(settings, 2, aircraft) == file
    assert load_aircraft(settings)[2] == aircraft
    text = file.read_text()
    kept = [each in text for each in ("# my plane", "# slow", "accel_bias_mps2", "mounting")]
    assert kept == [True, True, True, False]


def test_setting_restored_to_default_is_removed_from_file(settings: GatewaySettings) -> None:
    default = settings.default_aircraft
    estimation = msgspec.convert({"paper": {"accel_cutoff_hz": 4.0}}, EstimationSettings)
    for aircraft in (msgspec.structs.replace(default, estimation=estimation), default):
        text = save_aircraft(settings, 1, aircraft).read_text()
        assert ("accel_cutoff_hz" in text) == (aircraft != default)
        assert load_aircraft(settings)[1] == aircraft


@pytest.mark.io
def test_aircraft_file_is_readable_by_owner_only(settings: GatewaySettings) -> None:
    secret = VehicleSettings(signing_passphrase="correct horse")
    aircraft = msgspec.structs.replace(settings.default_aircraft, vehicle=secret)
    for _ in range(2):
        file = save_aircraft(settings, 3, aircraft)
        assert stat.S_IMODE(file.stat().st_mode) == 0o600
        assert [*file.parent.iterdir()] == [file]
        file.chmod(0o644)


@pytest.mark.io
def test_invalid_settings_are_not_saved_and_a_damaged_file_is_not_overwritten(
    settings: GatewaySettings,
) -> None:
    flat = NodeCalibration(gyro_bias_radps=(0.0, 99.0, 0.0))
    aircraft = msgspec.structs.replace(settings.default_aircraft, calibration=flat)
    with pytest.raises(OSError, match="would be invalid"):
        save_aircraft(settings, 3, aircraft)
    file = aircraft_file(settings, 3)
    assert not file.exists()
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(b"[vehicle\xff")
    with pytest.raises(OSError, match="repair or remove it"):
        save_aircraft(settings, 3, settings.default_aircraft)
    assert file.read_bytes() == b"[vehicle\xff"


def test_endpoint_is_added_to_file_with_comments_kept(tmp_path: Path) -> None:
    file = tmp_path / "new" / "gateway.toml"
    save_endpoint(file, url := "tcp-listen:127.0.0.1:5760")
    assert load(file).hub.endpoints == (*GatewaySettings().hub.endpoints, url)
    file.write_text('# mine\n[hub]\nendpoints = [\n  "udp:127.0.0.1:1", # here\n]\n')
    file.chmod(0o644)
    save_endpoint(file, "udp:127.0.0.1:2")
    assert stat.S_IMODE(file.stat().st_mode) == 0o644, "a service can still read it"
    assert load(file).hub.endpoints == ("udp:127.0.0.1:1", "udp:127.0.0.1:2")
    before = file.read_text()
    assert re.search("# mine(?s:.*)# here", before)
    for wrong in ("udp:127.0.0.1:2", "nonsense"):
        with pytest.raises(ConfigError):
            save_endpoint(file, wrong)
    assert file.read_text() == before


def test_sources_besides_the_receiver_are_found() -> None:
    usual = HubSettings().endpoints
    for url in ("serial:/dev/ttyACM0:57600", "udp-listen:0.0.0.0:14552", "tcp:192.168.1.9:5760"):
        assert HubSettings(endpoints=(*usual, url)).has_other_sources, url
    assert not HubSettings(endpoints=(*usual, "udp:192.168.1.20:14550")).has_other_sources


def test_passphrase_that_others_can_read_is_named(tmp_path: Path) -> None:
    file, aircraft = tmp_path / "gateway.toml", tmp_path / "1.toml"
    own = '[vehicle]\nsigning_passphrase = "x"'
    aircraft.write_text(own)
    aircraft.chmod(0o644)
    for text, mode, is_exposed in (
        (own, 0o644, True),
        (own, 0o640, False),
        ('[[fleet.site]]\nname = "a"\npassphrase = "x"', 0o604, True),
        ("", 0o644, False),
    ):
        file.write_text(f'aircraft_folder = "{tmp_path}"\n{text}')
        file.chmod(mode)
        settings = load(file)
        assert bool(exposed_secrets(file, settings, {})) is is_exposed, (text, mode)
        *_, warning = exposed_secrets(file, settings, load_aircraft(settings))
        assert f"{aircraft} has a passphrase" in warning


LIMIT_S = 5.0
DEEP = 50_000


@pytest.mark.parametrize(
    ("text", "why"),
    [
        pytest.param(".".join(["a"] * DEEP) + " = 1", "line 1: is nested", id="dotted key"),
        pytest.param("\n\n[" + ".".join(["a"] * DEEP) + "]", "line 3: is nested", id="section"),
        pytest.param('"a" . ' * DEEP + "b = 1", "nested", id="quoted parts"),
        pytest.param("x = " + "[" * DEEP, "nested", id="lists"),
        pytest.param("x = " + "{a=" * DEEP, "nested", id="tables"),
        pytest.param('x = """\n"""\ny = ' + "[" * DEEP, "line 3: is nested", id="after a text"),
        pytest.param("# " + "x" * MAX_BYTES, "more than 1 MB", id="large"),
        pytest.param("x = " + "1" * 100_000, "not valid TOML", id="long number"),
        pytest.param("[columns", "not valid TOML", id="cut"),
        pytest.param("\x80", "line 1: is not UTF-8 text; save it as UTF-8", id="not UTF-8"),
        pytest.param('x = "t"\n\xe4 = 1\n', "line 2: is not UTF-8 text", id="not UTF-8 below"),
    ],
)
def test_hostile_text_is_refused_in_a_moment(tmp_path: Path, text: str, why: str) -> None:
    file = tmp_path / "file.toml"
    file.write_text(text, encoding="latin-1")
    begin_s = time.process_time()
    with pytest.raises(TomlError, match=why):
        read_toml(file)
    with pytest.raises(ConfigError, match=why):
        load(file)
    with pytest.raises(FlightError, match=why):
        read_column_map(file)
    assert time.process_time() - begin_s < LIMIT_S


def test_pipes_and_devices_are_refused(tmp_path: Path) -> None:
    os.mkfifo(pipe := tmp_path / "pipe")
    for reader, path in itertools.product((load, read_column_map), (pipe, Path("/dev/zero"))):
        with pytest.raises((ConfigError, FlightError), match="is a pipe or a device"):
            reader(path)


def test_usual_nesting_and_texts_with_brackets_are_read(tmp_path: Path) -> None:
    file = tmp_path / "file.toml"
    for text in (
        "x = 'a.b.c.d.e.f.g.h.i.j.k'  # [[[[[[[[[[",
        'x = """\n[[[[[[[[[[\n{{{{{{{{{{\n"""',
        "x = " + "[" * MAX_DEPTH + "]" * MAX_DEPTH,
        ".".join(["a"] * MAX_DEPTH) + " = 1.5",
        "\n".join(f"a{n}.b.c = {n}.5" for n in range(1000)),
        "x = [1.5, 2.5, 3.5, 4.5, 5.5, 6.5, 7.5, 8.5, 9.5, 10.5]",
    ):
        file.write_text(text)
        assert read_toml(file), text[:60]


def test_only_some_of_many_errors_are_listed(tmp_path: Path) -> None:
    file = tmp_path / "file.toml"
    file.write_text("\n".join(f"unknown{n} = 1" for n in range(30_000)))
    begin_s = time.process_time()
    with pytest.raises(ConfigError) as refused:
        load(file)
    assert len(str(refused.value).splitlines()) == MAX_ERRORS + 1
    file.write_text("[columns]\n" + "\n".join(f"unknown{n} = 'x'" for n in range(30_000)))
    with pytest.raises(FlightError) as unmapped:
        read_column_map(file)
    assert len(str(unmapped.value)) < 1000
    assert time.process_time() - begin_s < LIMIT_S
