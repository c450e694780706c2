"""The table of all texts and warnings in docs/troubleshooting.md, and the tool that writes it."""

import tomllib
from pathlib import Path

import pytest

from tools.make_troubleshooting import EXPLANATIONS, PAGE, ROOT, Sources, explained, page_of

PACKAGE = """
PREFIX: Final = "Note: "
STATES: Final = ((1, "bent", "straight"), (2, "hot", "cool"))

def emit(text):
    return StatusText(INFO, text)

class Radio:
    def poll(self, is_bad, row):
        text = "radio lost" if is_bad else f"radio {self.name} is back"
        emit(text)
        emit(PREFIX + row.text)
        log.warning("%s: no answer after %d s", self.name, 3)
        log.info("not listed")
        for flag, raised, fallen in STATES:
            bad, good = (fallen, raised) if is_bad else (raised, fallen)
            emit_both(status_text(is_bad, bad, good, 4))
"""

STATES = ("bent", "straight", "hot", "cool")


@pytest.fixture(scope="module")
def sources() -> Sources:
    return Sources(ROOT / "gateway")


@pytest.fixture
def radio(tmp_path: Path) -> Sources:
    (tmp_path / "radio.py").write_text(PACKAGE)
    return Sources(tmp_path)


def test_page_contains_every_message_with_cause_and_remedy(sources: Sources) -> None:
    page, wrong = page_of(sources, tomllib.loads(EXPLANATIONS.read_text()))
    assert wrong == [], "explain it in docs/troubleshooting.toml"
    assert PAGE.read_text() == page, "run python -m tools.make_troubleshooting"


def test_tool_finds_messages_behind_parameters_conditions_and_constants(radio: Sources) -> None:
    assert {(each.kind, each.pattern) for each in radio.messages()} == {
        ("text", "radio lost"),
        ("text", "radio … is back"),
        ("text", "Note: …"),
        *(("text", state) for state in STATES),
        ("log", "…: no answer after … s"),
    }


def test_messages_of_every_part_are_found(sources: Sources) -> None:
    found = sources.messages()
    assert len({message.pattern for message in found}) > 80
    files = {message.source.rpartition("/")[0] for message in found}
    for part in ("vehicle", "hub", "live", "fleet", "panel"):
        assert any(file.startswith(f"gateway/{part}") for file in files), part


def test_tool_reports_unexplained_messages(radio: Sources) -> None:
    words = ("radio", "Note", *STATES)
    entries = [{"match": word, "cause": "a", "remedy": "b"} for word in words]
    _, [wrong] = explained(radio.messages(), entries)
    assert "no answer after" in wrong
