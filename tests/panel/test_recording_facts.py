from pathlib import Path

import pytest

from gateway.batch.catalogue import Catalogue, CataloguedFile
from gateway.batch.facts import FlightFacts
from gateway.panel.recording_jobs import RecordingFacts

pytestmark = pytest.mark.io


def catalogue(folder: Path, **seconds: float) -> None:
    catalogue = Catalogue(folder)
    for name, duration in seconds.items():
        for kind in ("tlog", "table"):
            facts = FlightFacts(duration=duration, loss=0.1 if kind == "table" else None)
            path = f"{name}.{kind}"
            catalogue.put([CataloguedFile(path, name, kind, 1, 1, path, flights=((facts, []),))])
    catalogue.close()


def test_a_recording_is_found_by_name_and_by_what_it_holds(tmp_path: Path) -> None:
    catalogue(tmp_path, Morning=400.0, evening=100.0)
    facts = RecordingFacts()
    facts.look(tmp_path, "morn")
    assert [facts.shows(name, "morn") for name in ("Morning", "evening")] == [True, False]
    row = facts.of("Morning")
    assert row is not None
    # The table contains more facts than the tlog next to it.
    assert (row["kind"], row["duration"], row["loss"]) == ("table", 400.0, 0.1)
    facts.look(tmp_path, "duration < 300")
    assert [facts.shows(name, "duration < 300") for name in ("Morning", "evening")] == [False, True]


def test_a_wrong_condition_is_reported_and_shows_nothing(tmp_path: Path) -> None:
    catalogue(tmp_path, a=1.0)
    facts = RecordingFacts()
    facts.look(tmp_path, "height > 3")
    assert "no such column: height" in facts.trouble
    assert not facts.shows("a", "height > 3")
    facts.look(tmp_path, "")
    assert (facts.trouble, facts.shows("a", "")) == ("", True)


def test_without_a_catalogue_names_are_searched_all_the_same(tmp_path: Path) -> None:
    facts = RecordingFacts()
    facts.look(tmp_path, "x")
    assert facts.of("x1") is None
    assert facts.shows("x1", "x")
    assert "once the recordings are indexed" in facts.trouble
    catalogue(tmp_path, x1=5.0)
    facts.look(tmp_path, "x")
    assert facts.trouble == ""
    assert facts.of("x1") is not None
