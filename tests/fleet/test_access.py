"""The router of docs/fleet.md as it stands there: a site writes its own keys only."""

import re
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from gateway.edges.hub.fleet_link.zenoh_session import open_session, session_config
from tests.ports import free_port

zenoh = pytest.importorskip("zenoh")

pytestmark = pytest.mark.io

DOC = Path(__file__).resolve().parents[2] / "docs" / "fleet.md"
PATIENCE_S = 60.0


def openssl(folder: Path, *words: str) -> None:
    subprocess.run(["openssl", *words], cwd=folder, check=True, capture_output=True)


def certify(folder: Path, name: str) -> None:
    """Make a key and a certificate that the authority vouches for."""
    new = ("req", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")
    openssl(folder, *new, "-keyout", f"{name}.key", "-out", f"{name}.csr", "-subj", f"/CN={name}")
    (folder / "names").write_text("subjectAltName=DNS:localhost,IP:127.0.0.1")
    sign = ("x509", "-req", "-in", f"{name}.csr", "-CA", "ca.pem", "-CAkey", "ca.key", "-days", "2")
    openssl(folder, *sign, "-CAcreateserial", "-extfile", "names", "-out", f"{name}.pem")


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("keys")
    new = ("req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")
    openssl(folder, *new, "-keyout", "ca.key", "-out", "ca.pem", "-subj", "/CN=ca", "-days", "2")
    for name in ("router", "field-1", "field-2", "office"):
        certify(folder, name)
    return folder


def written(folder: Path, number: int, **names: str) -> Path:
    """Take a configuration out of the document, its files replaced by ours."""
    blocks = re.findall(r"^    \{\n(?:    .*\n|\n)*?    \}$", DOC.read_text(), re.MULTILINE)
    text = re.sub(r'"/etc/\w+/([\w.-]+)"', lambda m: f'"{folder}/{m[1]}"', blocks[number])
    for old, new in names.items():
        text = text.replace(old.replace("_", "-"), new)
    file = folder / f"{number}-{'-'.join(names.values())}.json5"
    file.write_text(text)
    return file


@pytest.fixture
def join(keys: Path) -> Iterator[Callable[[str], Any]]:
    """Open the router, then a session for whoever has a certificate."""
    place = f"tls/localhost:{free_port()}"
    opened = [open_session(session_config(place, str(written(keys, 1)), "router"))]

    def make(name: str) -> Any:
        file = written(keys, 0, field_1=name)
        opened.append(open_session(session_config(place, str(file))))
        return opened[-1]

    yield make
    for session in reversed(opened):
        session.close()


def heard(session: Any, key: str) -> list[tuple[str, bytes]]:
    """Note what comes on a key."""
    got: list[tuple[str, bytes]] = []
    session.declare_subscriber(
        key, lambda sample: got.append((str(sample.key_expr), sample.payload.to_bytes()))
    )
    return got


def until(condition: Callable[[], bool], *shown: object) -> None:
    """Wait for a condition; if it never holds, say what there is instead."""
    end_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end_s, shown
        time.sleep(0.02)


def test_a_site_writes_its_own_keys_only(join: Callable[[str], Any]) -> None:
    office, site = join("office"), join("field-1")
    out = heard(office, "mavlink/*/*/out")
    tokens: list[str] = []
    office.liveliness().declare_subscriber(
        "mavlink/*/site/*", lambda sample: tokens.append(str(sample.key_expr)), history=True
    )
    # A token ends with its object.
    kept = [site.liveliness().declare_token(f"mavlink/field-{k}/site/x") for k in (1, 2)]
    asked = site.declare_queryable("mavlink/field-1/ping", lambda q: q.reply(q.key_expr, b"here"))
    orders, others = heard(site, "mavlink/field-1/*/in"), heard(site, "mavlink/field-2/*/out")

    def both() -> bool:
        site.put("mavlink/field-2/1/out", b"forged")
        site.put("mavlink/field-1/1/out", b"own")
        office.put("mavlink/field-1/1/in", b"order")
        office.put("mavlink/field-2/1/out", b"another's")
        return bool(out and orders and tokens)

    until(both, out, orders, tokens)
    replies = [r.ok.payload.to_bytes() for r in office.get("mavlink/field-1/ping") if r.ok]
    assert replies == [b"here"]
    site.put("mavlink/field-1/1/out", b"last")
    until(lambda: out[-1][1] == b"last", out)
    assert {key for key, data in out if data in (b"own", b"last", b"forged")} == {
        "mavlink/field-1/1/out"
    }
    assert set(tokens) == {"mavlink/field-1/site/x"}
    assert {data for _, data in orders} == {b"order"}
    assert b"another's" not in {data for _, data in others}, "nor does it read another's"
    for one in (asked, *kept):
        one.undeclare()


def test_a_certificate_that_no_rule_names_may_nothing(join: Callable[[str], Any]) -> None:
    office, stranger, site = join("office"), join("field-2"), join("field-1")
    out = heard(office, "mavlink/*/*/out")

    def said() -> bool:
        stranger.put("mavlink/field-2/1/out", b"stranger")
        stranger.put("mavlink/field-1/1/out", b"stranger")
        site.put("mavlink/field-1/1/out", b"own")
        return len(out) > 20

    until(said, out)
    assert {data for _, data in out} == {b"own"}
