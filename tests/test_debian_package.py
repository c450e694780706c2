"""The wheel, and the Debian package of it, installed into a root of its own by dpkg."""

import gzip
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from gateway.cli.app import COMMANDS
from gateway.config import aircraft_folder, load
from gateway.live.control_socket import GROUP, SERVICE_FOLDER
from gateway.live.serial_port import KNOWN_ADAPTERS
from tests.conftest import ROOT
from tests.kit.process import python

pytestmark = [
    pytest.mark.io,
    pytest.mark.slow,
    pytest.mark.skipif(not shutil.which("dpkg-deb"), reason="needs Debian's dpkg-deb"),
]
UNIT = "usr/lib/systemd/system/mavgate.service"


SOURCE_TIME_S = 1_700_000_000
"""Time of all files of a wheel, s since 1970."""


@pytest.fixture(scope="module")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two wheels of the same sources, made in two folders."""
    # Another test may make the images at the same time.
    made_files = ("build", "dist", "__pycache__", "images")
    skipped = shutil.ignore_patterns(".*", *made_files, "tests", "firmware")
    words = ["-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "-w"]
    made = list[Path]()
    for name in ("first", "second"):
        folder = tmp_path_factory.mktemp(name)
        shutil.copytree(ROOT, folder / "source", ignore=skipped)
        environment = os.environ | {"SOURCE_DATE_EPOCH": str(SOURCE_TIME_S)}
        command = [sys.executable, *words, folder, folder / "source"]
        subprocess.run(command, check=True, env=environment)
        made.extend(folder.glob("mavgate-*-py3-none-linux_*.whl"))
    return made


def test_wheel_has_the_kernels_and_two_builds_are_equal(wheels: list[Path]) -> None:
    first, second = wheels
    assert first.read_bytes() == second.read_bytes()
    with zipfile.ZipFile(first) as archive:
        names = archive.namelist()
        assert archive.read("gateway/compiled/kernels.so").startswith(b"\x7fELF")
    assert not [name for name in names if name.startswith(("tests/", "tools/"))]


@pytest.fixture(scope="module")
def package(wheels: list[Path]) -> Path:
    """The package without its dependencies, which are the same locked ones as here."""
    subprocess.run(
        [ROOT / "tools" / "make_deb.sh", wheels[0].parent],
        check=True,
        env=os.environ | {"PYTHON": sys.executable, "LOCK": ""},
    )
    [made] = wheels[0].parent.glob("mavgate_*.deb")
    return made


@pytest.fixture(scope="module")
def unpacked(package: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("root")
    subprocess.run(["dpkg-deb", "--extract", package, root], check=True)
    return root


def dpkg(root: Path, *words: object) -> str:
    """Run dpkg as for a system below `root`, which its scripts know."""
    command = ["dpkg", f"--root={root}", "--force-script-chrootless", "--force-depends"]
    done = subprocess.run([*command, *map(str, words)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.skipif(
    os.geteuid() != 0 or not shutil.which("systemd-sysusers"),
    reason="needs root, and systemd-sysusers",
)
def test_package_installs_and_purge_keeps_flights(package: Path, tmp_path: Path) -> None:
    root = tmp_path / "root"
    for folder in ("var/lib/dpkg/info", "var/lib/dpkg/updates", "etc"):
        (root / folder).mkdir(parents=True)
    (root / "var/lib/dpkg/status").touch()
    dpkg(root, "--install", package)
    assert "Status: install ok installed" in dpkg(root, "--status", "mavgate")
    users = dict(line.split(":", 1) for line in (root / "etc/passwd").read_text().splitlines())
    assert "/var/lib/mavgate" in users["mavgate"]
    members = (root / "etc/group").read_text()
    assert f"{GROUP}:" in members
    assert any(line.startswith("dialout:") and "mavgate" in line for line in members.splitlines())
    settings = root / "etc/mavgate/gateway.toml"
    [group] = [line.split(":")[2] for line in members.splitlines() if line.startswith(f"{GROUP}:")]
    found = settings.stat()
    assert (found.st_uid, found.st_gid, found.st_mode & 0o777) == (0, int(group), 0o640)
    settings.write_text(settings.read_text() + "# my own\n")
    flights = root / "var/lib/mavgate/recordings"
    flights.mkdir(parents=True)
    dpkg(root, "--remove", "mavgate")
    assert "# my own" in settings.read_text(), "settings outlive a removal"
    dpkg(root, "--purge", "mavgate")
    assert not settings.exists()
    assert flights.exists(), "flights outlive all"
    assert not (root / "usr/lib/mavgate").exists()


def test_program_and_its_children_use_their_own_packages(unpacked: Path) -> None:
    program = unpacked / "usr/bin/mavgate"
    code = f"""
import atexit, runpy, subprocess, sys
where = "import gateway; print(gateway.__file__)"
atexit.register(subprocess.run, [sys.executable, "-c", where])
sys.argv[:] = [{str(program)!r}, "--version"]
runpy.run_path({str(program)!r}, run_name="__main__")
"""
    version, used = python("-c", code, cwd=unpacked).stdout.splitlines()
    assert version.startswith("mavgate ")
    assert used.startswith(str(unpacked))
    script = program.read_text()
    assert script.startswith("#!/usr/bin/python3\n")
    major, minor, *_ = sys.version_info
    assert f'MADE_FOR = "{major}.{minor}"' in script


def test_unit_starts_the_installed_program_with_its_settings(unpacked: Path) -> None:
    lines = (unpacked / UNIT).read_text().splitlines()
    [start] = (line.removeprefix("ExecStart=") for line in lines if line.startswith("ExecStart="))
    assert os.access(unpacked / start.split()[0].lstrip("/"), os.X_OK)
    assert "--config /etc/mavgate/gateway.toml" in start
    # Without the last one it stays down after five bad starts.
    assert {"User=mavgate", "StateDirectory=mavgate", "StartLimitIntervalSec=0"} <= {*lines}
    assert f"RuntimeDirectory={SERVICE_FOLDER.name}" in lines
    [guide] = (line for line in lines if line.startswith("Documentation=file://"))
    assert (unpacked / guide.removeprefix("Documentation=file:///")).is_file()
    assert "u mavgate " in (unpacked / "usr/lib/sysusers.d/mavgate.conf").read_text()
    settings = load(unpacked / "etc/mavgate/gateway.toml")
    for folder in (aircraft_folder(settings), Path(settings.recording.folder)):
        assert folder.is_relative_to("/var/lib/mavgate")


@pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="needs systemd-analyze")
def test_systemd_accepts_the_unit_and_its_security_score_is_low(
    unpacked: Path, tmp_path: Path
) -> None:
    """With a program in place of ours, which is not installed here.

    Of 10, as `systemd-analyze security` counts; a service without any restriction has 9.6.
    """
    unit = tmp_path / "mavgate.service"
    text = (unpacked / UNIT).read_text()
    unit.write_text(text.replace("/usr/bin/mavgate", "/bin/true").replace("User=mavgate\n", ""))
    security = ("security", "--offline=true", "--threshold=20", unpacked / UNIT)
    for words in (("verify", "--man=no", unit), security):
        command = ["systemd-analyze", *words]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if words == security:
            assert done.returncode == 0, done.stdout
        else:
            assert "mavgate" not in done.stderr, done.stderr


def test_every_known_adapter_has_its_rule(unpacked: Path) -> None:
    rules = (unpacked / "usr/lib/udev/rules.d/60-mavgate.rules").read_text()
    for vendor, product in KNOWN_ADAPTERS:
        ids = f'ATTR{{idVendor}}=="{vendor:04x}", ATTR{{idProduct}}=="{product:04x}"'
        assert ids in rules
    assert 'ATTR{latency_timer}="1"' in rules


def test_documents_manual_page_and_completion_are_installed(unpacked: Path) -> None:
    documents = unpacked / "usr/share/doc/mavgate"
    shipped = {path.name for path in documents.glob("*.md")}
    assert shipped >= {path.name for path in (ROOT / "docs").glob("*.md")}
    bash, zsh = "bash-completion/completions/mavgate", "zsh/vendor-completions/_mavgate"
    for path in (bash, zsh, "fish/vendor_completions.d/mavgate.fish"):
        assert "_MAVGATE_COMPLETE" in (unpacked / "usr/share" / path).read_text()
    page = gzip.decompress((unpacked / "usr/share/man/man1/mavgate.1.gz").read_bytes()).decode()
    described = page.replace("\\-", "-")
    assert [name for name in COMMANDS if f".SS mavgate {name} " not in described] == []


def test_no_file_names_the_folder_of_the_build(unpacked: Path) -> None:
    names = [path for path in unpacked.rglob("*") if path.is_file() and path.suffix != ".pyc"]
    texts = [path.read_bytes() for path in names]
    assert not [name for name, text in zip(names, texts, strict=True) if bytes(ROOT) in text]
