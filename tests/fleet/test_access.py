"""Mutual TLS with the commands and files of docs/fleet.md as they stand there."""

import os
import re
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

import pytest
from msgspec.structs import replace

from gateway.config import load
from gateway.hub.transports.zenoh.session import open_session, session_config
from tests.fleet.conftest import World, opened_world
from tests.kit.hub import Rig
from tests.kit.process import START_LIMIT_S
from tests.ports import free_port

zenoh = pytest.importorskip("zenoh")

pytestmark = pytest.mark.io

DOC = Path(__file__).resolve().parents[2] / "docs" / "fleet.md"
NEW_CA = (
    "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 2 "
    "-subj /CN=mavgate-fleet -keyout ca.key -out ca.pem && "
    "openssl req -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -subj /CN=field-1 "
    "-keyout field-1.key -out field-1.csr && printf extendedKeyUsage=clientAuth > ext && "
    "openssl x509 -req -in field-1.csr -CA ca.pem -CAkey ca.key -CAcreateserial -days 2 "
    "-extfile ext -out field-1.pem"
)


@dataclass
class Documented:
    """The section of the document, with its paths and addresses replaced by those of the test."""

    folder: Path
    locator: str
    site_url: str

    def site_file(self, name: str, keys: Path | None = None) -> Path:
        """Write the documented configuration of a site for another name or folder of keys."""
        text = (self.folder / "site.json5").read_text().replace("field-1", name)
        if keys is not None:
            text = re.sub(rf'"{self.folder}/(field-1\.\w+)"', rf'"{keys}/\1"', text)
        file = self.folder / f"site-{name}{'-other' if keys else ''}.json5"
        file.write_text(text)
        return file


@pytest.fixture(scope="module")
def documented(tmp_path_factory: pytest.TempPathFactory) -> Documented:
    """Run the documented commands and write the documented files."""
    folder, port = tmp_path_factory.mktemp("etc"), free_port()
    section = DOC.read_text().split("## Mutual TLS\n")[1].split("\n## ")[0]
    commands = []
    for language, text in re.findall(r"^```(\w+)\n(.*?)^```$", section, re.MULTILINE | re.DOTALL):
        text = text.replace("/etc/mavgate", str(folder)).replace("fleet.example", "localhost")
        text = text.replace("0.0.0.0", "127.0.0.1").replace(":7447", f":{port}")
        if language == "sh":
            commands.append(text)
        else:
            [name] = re.findall(rf"^(?://|#) {folder}/(\S+)$", text, re.MULTILINE)
            (folder / name).write_text(text)
    setup, add = commands
    subprocess.run(["bash", "-euc", setup], check=True, capture_output=True)
    [url] = re.findall(r"mavgate clients add '(.*)'", add)
    return Documented(folder, f"tls/localhost:{port}", url)


def answers(locator: str) -> bool:
    """Return whether a router still accepts connections; it ends on a thread."""
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", int(locator.rpartition(":")[2]))) == 0


@pytest.fixture
async def world(
    rig: Rig, documented: Documented, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Any:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    settings = load(documented.folder / "fleet.toml")
    fleet = replace(settings.fleet, ids_file=str(tmp_path / "ids.json"))
    hub = replace(settings.hub, endpoints=())
    async with opened_world(rig, fleet, hub, documented.locator) as world:
        yield world
    # The next test's router listens at the same port.
    await rig.until(lambda: not answers(documented.locator))


async def test_documented_site_is_shown_and_commanded_through_the_documented_fleet(
    world: World, documented: Documented, caplog: pytest.LogCaptureFixture
) -> None:
    world.add_site("field-1", documented.site_url)
    await world.until(lambda: world.systems() == {1})
    world.station.send(world.station.sender.command(1, 1))
    await world.until(lambda: bool(world.commands("field-1")))
    assert world.received["field-1"][-1].trusted
    assert caplog.get_records("setup") == [], "no warning at its start"


async def test_certificate_of_a_site_opens_no_other(world: World, documented: Documented) -> None:
    world.add_site("field-1", documented.site_url)
    options = f"&config={documented.site_file('field-2')}"
    # The certificate of field-2, the name of field-1.
    url = f"zenoh:{documented.locator}?site=field-1{options}"
    world.add_site("forger", url, system=66)
    world.add_site("field-2", url.replace("site=field-1", "site=field-2"), system=2)
    await world.until(lambda: {1, 2} <= world.systems())
    await world.until(lambda: len(world.got) > 300)
    assert world.systems() == {1, 2}
    assert {name: site["sessions"] for name, site in world.shown().items()} == {
        "field-1": 1, "field-2": 1,
    }  # fmt: skip


@pytest.fixture
def join(documented: Documented) -> Iterator[Callable[[str], Any]]:
    """Open the documented router without a fleet, then a session for each certificate."""
    router_file = str(documented.folder / "fleet.json5")
    opened = [open_session(session_config(documented.locator, router_file, "router"))]

    def make(name: str) -> Any:
        file = str(documented.site_file(name))
        opened.append(open_session(session_config(documented.locator, file)))
        return opened[-1]

    yield make
    for session in reversed(opened):
        session.close()


def test_client_without_certificate_of_the_authority_is_refused(
    join: Callable[[str], Any], documented: Documented, tmp_path: Path
) -> None:
    assert join("field-1").info.routers_zid()
    one_way = tmp_path / "one-way.json5"
    one_way.write_text(
        f'{{transport: {{link: {{tls: {{root_ca_certificate: "{documented.folder}/ca.pem"}}}}}}}}'
    )
    subprocess.run(["bash", "-euc", NEW_CA], check=True, capture_output=True, cwd=tmp_path)
    foreign = documented.site_file("field-1", tmp_path)
    for file in (one_way, foreign):
        with pytest.raises(OSError, match="or a certificate does not fit"):
            open_session(session_config(documented.locator, str(file)))


def test_site_reads_and_writes_its_own_keys_only(join: Callable[[str], Any]) -> None:
    first, second = join("field-1"), join("field-2")
    got, arrived = list[tuple[str, bytes]](), SimpleQueue[tuple[str, bytes]]()
    for key in ("mavlink/field-1/1/out", "mavlink/field-2/1/out"):
        second.declare_subscriber(
            key, lambda sample: arrived.put((str(sample.key_expr), sample.payload.to_bytes()))
        )
    end_s = time.monotonic() + START_LIMIT_S
    while len(got) < 20:
        assert time.monotonic() < end_s
        first.put("mavlink/field-1/1/out", b"telemetry of field-1")
        first.put("mavlink/field-2/1/out", b"forged")
        second.put("mavlink/field-2/1/out", b"own")
        with suppress(Empty):
            # Nothing arrives before both sessions know of the subscription.
            got.append(arrived.get(timeout=0.02))
    assert set(got) == {("mavlink/field-2/1/out", b"own")}


@pytest.mark.parametrize("file", ["/dev/null", "large"])
def test_device_or_large_file_as_configuration_is_refused_unread(tmp_path: Path, file: str) -> None:
    path = tmp_path / file
    if file == "large":
        path.touch()
        os.truncate(path, 1 << 30)
    with pytest.raises(ValueError, match=r"not a regular file of at most 1048576 bytes"):
        session_config("tcp/127.0.0.1:7447", str(path))
