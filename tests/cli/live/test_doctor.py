"""`mavgate doctor`: every check finds what is wrong, and says what helps."""

import grp
import os
import socket
import subprocess
import sys
from getpass import getuser
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
from msgspec.structs import replace

from gateway.cli.live import doctor
from gateway.cli.live.doctor import Diagnosis, Grade
from gateway.compiled.entry_point import LibraryError
from gateway.config import GatewaySettings
from gateway.extras import EXTRAS
from gateway.live.serial_port import Port
from tests.kit.cli import invoke

pytestmark = pytest.mark.io

NAMELESS = 3_999_999_999
"""A user id without a name."""


@pytest.fixture
def settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> GatewaySettings:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(doctor, "TTY", tmp_path / "tty")
    settings = GatewaySettings(aircraft_folder=str(tmp_path / "aircraft"))
    settings = changed(settings, "recording", folder=str(tmp_path / "recordings"))
    settings = changed(settings, "serial", port=str(tmp_path / "ttyUSB7"))
    return changed(settings, "hub", endpoints=("udp:127.0.0.1:14550",))


def changed(settings: GatewaySettings, section: str, **values: object) -> GatewaySettings:
    return replace(settings, **{section: replace(getattr(settings, section), **values)})


def one(check: doctor.Check, settings: GatewaySettings) -> Diagnosis:
    [found] = check(settings)
    return found


@pytest.mark.parametrize(
    ("user", "members", "text"),
    [
        (os.getuid(), [], "`sudo usermod -aG dialout"),
        (os.getuid(), [getuser()], "is in the group dialout only from the"),
        (NAMELESS, [], "accessible to the group"),
    ],
)
def test_port_is_wrong_with_a_hint_if_missing_or_without_rights(
    settings: GatewaySettings,
    monkeypatch: pytest.MonkeyPatch,
    user: int,
    members: list[str],
    text: str,
) -> None:
    missing = one(doctor.check_receiver, settings)
    assert (missing.grade, "does not exist" in missing.text) == (Grade.FAIL, True)
    Path(settings.serial.port).touch()
    assert one(doctor.check_receiver, settings).grade is Grade.OK
    monkeypatch.setattr(os, "access", lambda *_: False)
    dialout = SimpleNamespace(gr_name="dialout", gr_mem=members)
    monkeypatch.setattr(grp, "getgrgid", lambda _: dialout)
    monkeypatch.setattr(os, "getuid", lambda: user)
    found = one(doctor.check_receiver, settings)
    assert (found.grade, text in found.text) == (Grade.FAIL, True)


@pytest.mark.parametrize(("latency_ms", "grade"), [(1, Grade.OK), (16, Grade.FAIL)])
def test_long_latency_timer_of_an_adapter_is_wrong(
    settings: GatewaySettings, tmp_path: Path, latency_ms: int, grade: Grade
) -> None:
    Path(settings.serial.port).touch()
    device = tmp_path / "tty" / "ttyUSB7" / "device"
    device.mkdir(parents=True)
    (device / "latency_timer").write_text(f"{latency_ms}\n")
    _, timer = doctor.check_receiver(settings)
    assert (timer.grade, f"{latency_ms} ms" in timer.text) == (grade, True)


def test_invalid_aircraft_file_is_wrong(settings: GatewaySettings) -> None:
    folder = Path(settings.aircraft_folder)
    folder.mkdir()
    assert one(doctor.check_settings, settings).grade is Grade.OK
    (folder / "3.toml").write_text("[vehicle]\nnope = 1\n")
    found = one(doctor.check_settings, settings)
    assert (found.grade, "3.toml: vehicle.nope" in found.text) == (Grade.FAIL, True)


@pytest.mark.parametrize("check", [doctor.check_aircraft, doctor.check_disk])
def test_folder_that_is_unwritable_or_below_a_file_is_wrong(
    settings: GatewaySettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, check: doctor.Check
) -> None:
    (tmp_path / "aircraft").touch()
    below = changed(settings, "recording", folder=f"{tmp_path}/aircraft/recordings")
    found = one(check, below)
    assert (found.grade, found.text) == (Grade.FAIL, f"{tmp_path}/aircraft is not a folder")
    (tmp_path / "aircraft").unlink()
    assert one(check, below).grade is Grade.OK
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert one(check, below).grade is Grade.FAIL


@pytest.mark.parametrize(("room_mb", "grade"), [(300, Grade.FAIL), (500, Grade.OK)])
def test_little_free_space_is_wrong(
    settings: GatewaySettings, monkeypatch: pytest.MonkeyPatch, room_mb: int, grade: Grade
) -> None:
    free = (settings.recording.free_floor_mb + room_mb) * 1e6
    monkeypatch.setattr(doctor, "free_bytes_near", lambda _: free)
    assert one(doctor.check_disk, settings).grade is grade


@pytest.mark.parametrize(
    ("kind", "make"), [("udp", socket.SOCK_DGRAM), ("tcp", socket.SOCK_STREAM)]
)
def test_port_of_another_program_is_wrong(
    settings: GatewaySettings, kind: str, make: socket.SocketKind
) -> None:
    with socket.socket(socket.AF_INET, make) as other:
        other.bind(("127.0.0.1", 0))
        if make is socket.SOCK_STREAM:
            other.listen()
        url = f"{kind}-listen:127.0.0.1:{other.getsockname()[1]}"
        taken = changed(settings, "hub", endpoints=(url,))
        found = one(doctor.check_ports, taken)
        assert (found.grade, found.text) == (Grade.FAIL, f"{url}: Address already in use")
    assert one(doctor.check_ports, taken).grade is Grade.OK


def test_ports_of_a_running_gateway_are_good(settings: GatewaySettings, tmp_path: Path) -> None:
    (tmp_path / "mavgate").mkdir(mode=0o700)
    with socket.socket(socket.AF_UNIX) as running:
        running.bind(str(tmp_path / "mavgate" / "run.sock"))
        running.listen()
        found = one(doctor.check_ports, settings)
    assert (found.grade, found.what) == (Grade.OK, "gateway")


@pytest.mark.parametrize(
    ("said", "grade"), [("yes", Grade.OK), ("no", Grade.INFO), (None, Grade.INFO)]
)
def test_clock_that_may_be_unsynchronised_is_noted(
    settings: GatewaySettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    said: str | None, grade: Grade,
) -> None:  # fmt: skip
    monkeypatch.setenv("PATH", str(tmp_path))
    if said is not None:
        (tmp_path / "timedatectl").write_text(f"#!/bin/sh\necho {said}\n")
        (tmp_path / "timedatectl").chmod(0o755)
    assert one(doctor.check_clock, settings).grade is grade


@pytest.mark.parametrize("missing", [False, True])
def test_missing_kernels_are_wrong_with_a_hint(
    settings: GatewaySettings, monkeypatch: pytest.MonkeyPatch, missing: bool
) -> None:
    error = LibraryError(Path("kernels.so"), "is missing")
    monkeypatch.setattr(doctor, "load_entry_points", Mock(side_effect=error if missing else None))
    found = one(doctor.check_kernels, settings)
    assert found.grade is (Grade.FAIL if missing else Grade.OK)
    assert ("make kernels" in found.text) == missing


def test_missing_extras_are_named(
    settings: GatewaySettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "nicegui", None)
    found = one(doctor.check_extras, settings)
    assert (found.grade, "needs the extra panel" in found.text) == (Grade.INFO, True)
    assert set(doctor.EXTRA_USES) == set(EXTRAS)


@pytest.mark.parametrize(
    ("port", "grades"), [("auto", [Grade.INFO]), ("none", []), ("usb:1:2", [Grade.FAIL])]
)
def test_receiver_is_missing_only_where_it_is_configured(
    settings: GatewaySettings, monkeypatch: pytest.MonkeyPatch, port: str, grades: list[Grade]
) -> None:
    monkeypatch.setattr(doctor, "list_serial_ports", list)
    found = doctor.check_receiver(changed(settings, "serial", port=port))
    assert [each.grade for each in found] == grades


def test_ports_and_adapters_that_match_are_listed(
    settings: GatewaySettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    ports = [
        Port(f"/dev/none{n}", f"1a86:{n}523", "A5" * n, "CH340", known=n < 2) for n in range(3)
    ]
    monkeypatch.setattr(doctor, "list_serial_ports", lambda: ports)
    found = list(doctor.check_receiver(changed(settings, "serial", port="auto")))
    assert found[1] == doctor.info("port", "/dev/none1, usb:1a86:1523:A5, CH340")
    assert "the gateway tries each: /dev/none0, /dev/none1" in found[3].text
    assert [each.grade for each in found[4:]] == [Grade.FAIL] * 2


@pytest.mark.parametrize("grade", list(Grade))
def test_exit_code_is_1_if_something_is_wrong(
    monkeypatch: pytest.MonkeyPatch, grade: Grade
) -> None:
    monkeypatch.setattr(doctor, "CHECKS", (lambda _: [Diagnosis(grade, "thing", "is so")],))
    result = invoke("doctor", code=1 if grade is Grade.FAIL else 0)
    assert result.output == f"{grade:4}  thing: is so\n"


@pytest.mark.parametrize(
    ("days", "grade", "word"),
    [
        (0, Grade.FAIL, "certificate has expired"),
        (3, Grade.INFO, "valid until"),
        (300, Grade.OK, "valid until"),
    ],
)
def test_expiring_certificate_is_noted_and_expired_one_wrong(
    settings: GatewaySettings, tmp_path: Path, days: int, grade: Grade, word: str
) -> None:
    key, request, file = (tmp_path / name for name in ("key.pem", "request.pem", "panel.pem"))
    curve = ("ec", "-pkeyopt", "ec_paramgen_curve:P-256")
    made = ("openssl", "req", "-new", "-newkey", *curve, "-nodes", "-subj", "/CN=mavgate")
    subprocess.run([*made, "-keyout", key, "-out", request], check=True, capture_output=True)
    signed = ("openssl", "x509", "-req", "-in", request, "-signkey", key, "-days", str(days))
    subprocess.run([*signed, "-out", file], check=True, capture_output=True)
    settings = changed(settings, "panel", certificate=str(file), certificate_key=str(key))
    found = one(doctor.check_certificates, settings)
    assert (found.grade, word in found.text) == (grade, True)


def test_missing_or_broken_certificate_is_wrong(settings: GatewaySettings, tmp_path: Path) -> None:
    assert list(doctor.check_certificates(settings)) == []
    file = tmp_path / "hub.pem"
    settings = changed(settings, "hub", tls_certificate=str(file))
    missing = f"{file}: No such file or directory"
    expected = Diagnosis(Grade.FAIL, "hub.tls_certificate", missing)
    assert one(doctor.check_certificates, settings) == expected
    file.write_text("no certificate")
    broken = one(doctor.check_certificates, settings)
    assert "no certificate" in broken.text.replace(str(file), "").lower()


def test_template_is_written_once_into_a_new_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    file = tmp_path / ".config" / "mavgate" / "gateway.toml"
    assert invoke("doctor", "--write").output == f"wrote {file}\n"
    template = file.read_text()
    assert (template, file.stat().st_mode & 0o777) == (
        invoke("doctor", "--template", "usual").output,
        0o600,
    )
    file.write_text("# mine")
    again = invoke("doctor", "--write")
    assert (again.exit_code, f"{file}: exists, and is not overwritten" in again.output) == (2, True)
    assert file.read_text() == "# mine"
    assert invoke("doctor", "--template", "all").output.count("\n[") > template.count("\n[")
