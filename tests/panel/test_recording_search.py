"""Search in recordings by name and by the figures of their catalogue."""

from pathlib import Path

import pytest

from gateway.batch.catalogue import Catalogue, CataloguedFile, FlightFigures
from gateway.batch.facts import CataloguedFlight
from gateway.panel.recording_search import RecordingFacts

pytestmark = pytest.mark.io


def catalogue(folder: Path, **seconds: float) -> None:
    catalogue = Catalogue(folder)
    for name, duration in seconds.items():
        for kind in ("tlog", "table"):
            facts = CataloguedFlight(duration=duration, loss=0.1 if kind == "table" else None)
            path = f"{name}.{kind}"
            catalogue.put([CataloguedFile(path, name, kind, 1, 1, path, flights=((facts, []),))])
    catalogue.close()


def test_recording_is_found_by_name_and_by_condition(tmp_path: Path) -> None:
    catalogue(tmp_path, Morning=400.0, evening=100.0)
    facts = RecordingFacts()
    facts.look(tmp_path, "morn")
    assert [facts.shows(name, "morn") for name in ("Morning", "evening")] == [True, False]
    # The table contains more facts than the tlog next to it.
    assert facts.of("Morning") == FlightFigures(400.0, loss=0.1)
    facts.look(tmp_path, "duration < 300")
    assert [facts.shows(name, "duration < 300") for name in ("Morning", "evening")] == [False, True]


@pytest.mark.parametrize(
    ("condition", "reason"),
    [
        ("height > 3", "'height' cannot be used here"),
        ("duration > > 3", "syntax error"),
        ("duration > 0 or length(hex(zeroblob(450000000))) > 0", "'length' cannot"),
        ("path = (select sql from sqlite_master)", "'select' cannot"),
        ("duration > 0; drop table flights", "';' cannot"),
        ("duration > 0" + " or duration > 0" * 50, "at most 500 characters"),
    ],
)
def test_invalid_condition_is_reported_and_matches_nothing(
    tmp_path: Path, condition: str, reason: str
) -> None:
    catalogue(tmp_path, a=1.0)
    facts = RecordingFacts()
    facts.look(tmp_path, condition)
    assert reason in facts.trouble
    assert not facts.shows("a", condition)
    facts.look(tmp_path, "")
    assert (facts.trouble, facts.shows("a", "")) == ("", True)


def test_names_are_searched_without_a_catalogue(tmp_path: Path) -> None:
    facts = RecordingFacts()
    facts.look(tmp_path, "x")
    assert facts.of("x1") is None
    assert facts.shows("x1", "x")
    assert "once the recordings are indexed" in facts.trouble
    catalogue(tmp_path, x1=5.0)
    facts.look(tmp_path, "x")
    assert facts.trouble == ""
    assert facts.of("x1") is not None
