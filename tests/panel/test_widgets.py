"""Parts of the page that stay the same while they are refreshed, built without a browser."""

import asyncio
import errno
import math
import os
from collections.abc import Iterator
from concurrent.futures.process import BrokenProcessPool
from types import SimpleNamespace
from typing import Any

import pytest
from nicegui import Client
from nicegui.page import page

from gateway.batch.catalogue import FlightFigures
from gateway.panel.dialogues import Dialogue
from gateway.panel.estimator_trial import ComparisonError
from gateway.panel.state.parameters import ParameterEntry, ParameterMeta
from gateway.panel.views import tuning_view
from gateway.panel.views.recordings_view import _facts_cells
from gateway.panel.views.tuning_view import ComparisonCard, ParameterRow, range_of
from gateway.panel.widgets import DataTable, RowButton, StripChart, why_not

NAME = "CAL_GYRO_BIAS_Z"


@pytest.fixture(autouse=True)
def _page() -> Iterator[None]:
    with Client(page("/"), request=None):
        yield


def test_button_of_a_row_acts_only_while_the_row_is_shown() -> None:
    pressed: list[str] = []
    table = DataTable(("Name",), "None.", buttons=[RowButton("close", "Remove", pressed.append)])
    table.show({"b": (("1", ""),), "d": (("2", "bad", "error"),)})
    assert table.props["rows"] == [
        {"key": "b", "cells": [["1", ""]]},
        {"key": "d", "cells": [["2", "bad", "error"]]},
    ]
    for key in ("d", "gone"):
        asyncio.run(table._on_act(SimpleNamespace(args=[0, key])))
    assert pressed == ["d"]


def test_control_characters_in_a_table_are_escaped_except_in_keys() -> None:
    table = DataTable(("Name",))
    table.show({"a\x1b[2J": (("a\x1b[2J", ""),)})
    assert table.props["rows"] == [{"key": "a\x1b[2J", "cells": [["a\\x1b[2J", ""]]}]


def row_of(sent: list[float]) -> tuple[ParameterRow, Dialogue]:
    """Build a row of a parameter that is 0, of an aircraft that never answers."""
    dialogue = Dialogue(1)
    dialogue.parameters.entries[NAME] = ParameterEntry(NAME, 0.0, 9, 0)

    def change(_: int, name: str, value: float) -> None:
        sent.append(value)
        dialogue.parameters.change(name, value, 0)

    dialogues = SimpleNamespace(of=lambda _: dialogue, change=change)
    context: Any = SimpleNamespace(
        may_change=True, check_may_change=lambda: None, parts=SimpleNamespace(dialogues=dialogues)
    )
    return ParameterRow(context, dialogue, ParameterMeta(name=NAME)), dialogue


def test_previous_value_is_sent_again_while_a_change_is_unanswered() -> None:
    sent: list[float] = []
    row, _ = row_of(sent)
    for value in (0.0, 0.8, 0.0):
        row._set(value)
    assert sent == [0.8, 0.0]


def test_typed_value_is_not_overwritten_by_its_own_answer() -> None:
    sent: list[float] = []
    row, dialogue = row_of(sent)
    row._field.set_value(0.8)
    row._set(0.8)
    # As 32 bits have it.
    dialogue.parameters.entries[NAME] = ParameterEntry(NAME, 0.800000011920929, 9, 0)
    dialogue.parameters._changes.clear()
    row.refresh(dialogue)
    assert row._field.value == 0.8
    row._set(0.8)
    assert sent == [0.8]
    dialogue.parameters.entries[NAME] = ParameterEntry(NAME, 0.5, 9, 0)
    row.refresh(dialogue)
    assert row._field.value == 0.5


def test_picture_has_a_longer_timeout_than_other_answers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    limits_s: list[float] = []
    answers = {"range": [1.0, 2.0], "picture": "data:"}

    async def run(name: str, *, timeout: float = 1.0) -> object:
        limits_s.append(timeout)
        return answers[name]

    chart = StripChart()
    monkeypatch.setattr(chart, "run_method", run)
    assert asyncio.run(chart.span_ms()) == (1.0, 2.0)
    assert asyncio.run(chart.picture()) == "data:"
    assert min(limits_s) >= 60.0


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (BrokenProcessPool("the process ended"), "Cannot be compared: the process ended."),
        (
            OSError(errno.ENOMEM, os.strerror(errno.ENOMEM)),
            "Cannot be compared: Cannot allocate memory.",
        ),
        (MemoryError(), "Cannot be compared: MemoryError."),
    ],
)
def test_failed_comparison_reports_the_reason_and_can_be_repeated(
    monkeypatch: pytest.MonkeyPatch, error: Exception, text: str
) -> None:
    card, failures = comparison_of(monkeypatch, [error, ComparisonError("no samples")])
    with pytest.raises(type(error)):
        asyncio.run(card._compare())
    assert (card._summary.text, card._button.enabled) == (text, True)
    asyncio.run(card._compare())
    again = "Cannot be compared: no samples."
    assert (card._summary.text, card._button.enabled) == (again, True)
    assert failures == []


@pytest.mark.parametrize("may_change", [True, False])
def test_opened_view_collects_samples_if_the_user_may_change_things(*, may_change: bool) -> None:
    asked: list[int] = []
    card = ComparisonCard(context_of(asked, share=0.4, may_change=may_change))
    assert asked == [1] * may_change
    assert not card._button.enabled
    assert card._button.props["title"] == "Collecting samples: 40%"
    card._context.parts.samples.collected = lambda *_: 1.0
    card._refresh()
    assert card._button.enabled


def context_of(asked: list[int], *, share: float, may_change: bool) -> Any:
    """A page on which that share of the needed samples is collected."""
    dialogues = SimpleNamespace(of=lambda _: Dialogue(1), ask_for_samples=asked.append)
    samples = SimpleNamespace(frames=lambda _: [], collected=lambda *_: share)
    return SimpleNamespace(
        system_id=1,
        may_change=may_change,
        parts=SimpleNamespace(dialogues=dialogues, samples=samples),
        on_select=lambda _: None,
        every=lambda *_: None,
    )


def comparison_of(
    monkeypatch: pytest.MonkeyPatch, failures: list[Exception]
) -> tuple[ComparisonCard, list[Exception]]:
    """Build a card whose comparisons fail in these ways, one after the other."""
    card = ComparisonCard(context_of([], share=1.0, may_change=False))

    async def fail(*_: object) -> None:
        assert not card._button.enabled
        raise failures.pop(0)

    monkeypatch.setattr(tuning_view, "compare_apart", fail)
    return card, failures


@pytest.mark.parametrize(
    ("state", "name", "allowed"),
    [
        ("idle", "", {"start"}),
        ("idle", "day", {"start", "save", "delete"}),
        ("recording", "day", {"stop", "save"}),
        ("opening", "day", {"stop", "save"}),
        ("blocked", "day", {"start", "stop", "save"}),
    ],
)
def test_recorder_offers_only_what_it_can_do(state: str, name: str, allowed: set[str]) -> None:
    verbs = ("start", "stop", "save", "delete")
    recorder = {"state": state, "name": name}
    assert {verb for verb in verbs if not why_not(verb, recorder)} == allowed


def test_angles_of_a_parameter_are_shown_in_degrees() -> None:
    meta = ParameterMeta(name=NAME, unit="rad/s", low=-10.0, high=10.0, default=0.0)
    assert range_of(meta) == "-572.96 to 572.96 °/s · default 0"
    assert range_of(ParameterMeta(name=NAME, unit="m", low=0.0)) == "0 to any m"


def test_unknown_figures_of_a_recording_are_dashes() -> None:
    assert _facts_cells(FlightFigures(61.2)) == ("0:01:01", "—", "—", ("—", ""))
    figures = FlightFigures(3601.0, distance=math.nan, highest=7.4, loss=0.1)
    assert _facts_cells(figures) == ("1:00:01", "—", "7 m", ("10.0%", "warn"))
