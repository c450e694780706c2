"""Parts of the page that stay the same while they are refreshed, built without a browser."""

import asyncio
import errno
import math
import os
from collections.abc import Callable, Iterator
from concurrent.futures.process import BrokenProcessPool
from types import SimpleNamespace
from typing import Any

import pytest
from nicegui import Client, ElementFilter, background_tasks, core, ui
from nicegui.page import page
from nicegui.testing.user_interaction import UserInteraction
from pymavlink.dialects.v20 import all as mavlink

from gateway.batch.catalogue import FlightFigures
from gateway.panel.dialogues import Dialogue
from gateway.panel.estimator_trial import ComparisonError
from gateway.panel.state.parameters import ParameterMeta
from gateway.panel.views.recordings_view import _facts_cells
from gateway.panel.views.tuning_view import ComparisonCard, ParameterRow, range_of
from gateway.panel.widgets import DataTable, RowButton, StripChart, why_not
from tests.panel.messages import decoded

NAME = "CAL_GYRO_BIAS_Z"


@pytest.fixture(autouse=True)
def _page() -> Iterator[None]:
    with Client(page("/"), request=None):
        yield


def emit(element: ui.element, kind: str, arguments: Any = None) -> None:
    """Emit an event as the browser does, and wait until its handlers have ended."""

    async def handle() -> None:
        core.loop = asyncio.get_running_loop()
        user: Any = SimpleNamespace(client=element.client)
        UserInteraction(user, {element}, None).trigger(kind, arguments)
        await asyncio.gather(*background_tasks.running_tasks, return_exceptions=True)
        core.loop = None

    asyncio.run(handle())


def labels() -> list[str]:
    return [label.text for label in ElementFilter(kind=ui.label)]


def test_button_of_a_row_acts_only_while_the_row_is_shown() -> None:
    pressed: list[str] = []
    table = DataTable(("Name",), "None.", buttons=[RowButton("close", "Remove", pressed.append)])
    table.show({"b": (("1", ""),), "d": (("2", "bad", "error"),)})
    assert table.props["rows"] == [
        {"key": "b", "cells": [["1", ""]]},
        {"key": "d", "cells": [["2", "bad", "error"]]},
    ]
    for key in ("d", "gone"):
        emit(table, "act", [0, key])
    assert pressed == ["d"]


def test_control_characters_in_a_table_are_escaped_except_in_keys() -> None:
    table = DataTable(("Name",))
    table.show({"a\x1b[2J": (("a\x1b[2J", ""),)})
    assert table.props["rows"] == [{"key": "a\x1b[2J", "cells": [["a\\x1b[2J", ""]]}]


class Row:
    """The row of a parameter that is 0, and what it sends to the aircraft."""

    def __init__(self) -> None:
        self.sent: list[float] = []
        self.dialogue = Dialogue(1)
        self.answer(0.0)
        dialogues = SimpleNamespace(of=lambda _: self.dialogue, change=self._change)
        context: Any = SimpleNamespace(
            may_change=True,
            check_may_change=lambda: None,
            parts=SimpleNamespace(dialogues=dialogues),
        )
        self.row = ParameterRow(context, self.dialogue, ParameterMeta(name=NAME))
        [self.field] = ElementFilter(kind=ui.number)

    def answer(self, value: float) -> None:
        """Let the aircraft report its value, which has 32 bits."""
        message = mavlink.MAVLink_param_value_message(NAME.encode(), value, 9, 1, 0)
        self.dialogue.parameters.handle(decoded(message), 0)

    def enter(self, value: float) -> None:
        self.field.set_value(value)
        emit(self.field, "keydown.enter")

    def _change(self, _: int, name: str, value: float) -> None:
        self.sent.append(value)
        self.dialogue.parameters.change(name, value, 0)


def test_previous_value_is_sent_again_while_a_change_is_unanswered() -> None:
    row = Row()
    for value in (0.0, 0.8, 0.0):
        row.enter(value)
    assert row.sent == [0.8, 0.0]


def test_typed_value_is_not_overwritten_by_its_own_answer() -> None:
    row = Row()
    row.enter(0.8)
    row.answer(0.8)
    row.row.refresh(row.dialogue)
    assert row.field.value == 0.8
    row.enter(0.8)
    assert row.sent == [0.8]
    row.answer(0.5)
    row.row.refresh(row.dialogue)
    assert row.field.value == 0.5


def test_picture_has_a_longer_timeout_than_other_answers(monkeypatch: pytest.MonkeyPatch) -> None:
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


class Page:
    """A page with the card of the comparison, on which a share of the samples is collected."""

    def __init__(self, share: float, *, may_change: bool = False) -> None:
        self.share = share
        self.asked: list[int] = []
        self.failures: list[Exception] = []
        """In which the comparisons end, one after the other."""
        self.refreshes: list[Callable[[], None]] = []
        dialogues = SimpleNamespace(of=lambda _: Dialogue(1), ask_for_samples=self.asked.append)
        samples = SimpleNamespace(frames=self._fail, collected=lambda *_: self.share)
        context: Any = SimpleNamespace(
            system_id=1,
            may_change=may_change,
            parts=SimpleNamespace(dialogues=dialogues, samples=samples),
            on_select=lambda _: None,
            every=lambda _, refresh: self.refreshes.append(refresh),
        )
        ComparisonCard(context)
        [self.button] = ElementFilter(kind=ui.button)

    def _fail(self, _: int) -> None:
        assert not self.button.enabled
        assert "Fusing …" in labels()
        raise self.failures.pop(0)


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (BrokenProcessPool("the process ended"), "the process ended"),
        (OSError(errno.ENOMEM, os.strerror(errno.ENOMEM)), "Cannot allocate memory"),
        (MemoryError(), "MemoryError"),
    ],
)
def test_failed_comparison_reports_the_reason_and_can_be_repeated(
    caplog: pytest.LogCaptureFixture, error: Exception, reason: str
) -> None:
    card = Page(1.0)
    card.failures = [error, ComparisonError("no samples")]
    for text in (reason, "no samples"):
        emit(card.button, "click")
        assert f"Cannot be compared: {text}." in labels()
        assert card.button.enabled
    assert card.failures == []
    assert [record.exc_info[1] for record in caplog.records if record.exc_info] == [error]


@pytest.mark.parametrize("may_change", [True, False])
def test_opened_view_collects_samples_if_the_user_may_change_things(*, may_change: bool) -> None:
    card = Page(0.4, may_change=may_change)
    assert card.asked == [1] * may_change
    assert not card.button.enabled
    assert card.button.props["title"] == "Collecting samples: 40%"
    assert "Collecting samples: 40%" in labels()
    card.share = 1.0
    for refresh in card.refreshes:
        refresh()
    assert card.button.enabled


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
    figures = FlightFigures(3601.0, distance=math.nan, highest=7.4, height_above="home", loss=0.1)
    assert _facts_cells(figures) == ("1:00:01", "—", "7 m above home", ("10.0%", "warn"))
