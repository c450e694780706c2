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


def test_page_contains_every_message_with_cause_and_remedy(sources: Sources) -> None:
    page, wrong = page_of(sources, tomllib.loads(EXPLANATIONS.read_text()))
    assert wrong == [], "explain it in docs/troubleshooting.toml"
    assert PAGE.read_text() == page, "run python -m tools.make_troubleshooting"


def test_tool_finds_messages_behind_parameters_conditions_and_constants(tmp_path: Path) -> None:
    folder = tmp_path / "package"
    folder.mkdir()
    (folder / "radio.py").write_text(PACKAGE)
    found = {(each.kind, each.pattern) for each in Sources(folder).messages()}
    assert found == {
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
    for part in (
        "gateway/vehicle",
        "gateway/hub",
        "gateway/live",
        "gateway/fleet",
        "gateway/panel",
    ):
        assert any(file.startswith(part) for file in files), part


def test_tool_reports_unexplained_messages(tmp_path: Path) -> None:
    folder = tmp_path / "package"
    folder.mkdir()
    (folder / "radio.py").write_text(PACKAGE)
    entries = [
        {"match": "radio", "cause": "a", "remedy": "b"},
        *({"match": word, "cause": "a", "remedy": "b"} for word in ("Note", *STATES)),
    ]
    _, wrong = explained(Sources(folder).messages(), entries)
    assert len(wrong) == 1
    assert "no answer after" in wrong[0]
