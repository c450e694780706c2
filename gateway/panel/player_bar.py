"""The player of a recording, below every view while one is open."""

from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any, Final

from nicegui import ui
from nicegui.element import Element
from nicegui.events import GenericEventArguments

from gateway.panel.playback import SPEEDS
from gateway.panel.view_context import WEB, ViewContext
from gateway.panel.widgets import icon_button, notify_failure, progress_shown

POSITION_S: Final = 0.25


async def open_playback(context: ViewContext, name: str, *, fused_again: bool = False) -> None:
    """Play a recording on this page, instead of the present one."""
    folder = context.parts.recordings_folder
    with progress_shown(f"Opening {name} …"), notify_failure(context):
        context.check_may_change()
        await context.playback.open(folder, name, fused_again=fused_again)


class TimeSlider(Element, component=WEB / "time_slider.js"):
    """A slider through a recording; emits `seek` with seconds since its start."""


class PlayerBar:
    """Play, pause, speed and the time, built at the current position in the page."""

    def __init__(self, context: ViewContext) -> None:
        self._context = context
        self._playback = context.playback
        with ui.element("div").classes("player").props("data-role=player") as self._bar:
            toggle = partial(self._play, self._playback.toggle)
            self._toggle = ui.button(icon="pause", on_click=toggle)
            self._toggle.props('round dense aria-label="Play or pause" title="Space"')
            for icon, to, title in (("replay_10", "-10", "Back"), ("forward_10", "+10", "Ahead")):
                seek = partial(self._play, self._playback.order, "seek", to=to)
                icon_button(icon, f"{title} ten seconds", seek)
            self._slider = TimeSlider()
            self._slider.on("seek", self._on_seek)
            self._speed = ui.select(
                {speed: f"{speed:g}×" for speed in SPEEDS}, value=1, on_change=self._on_speed
            )
            self._speed.props('dense borderless options-dense aria-label="Speed"')
            self._fused_again = ui.switch("fused again next to it", on_change=self._on_fused_again)
            icon_button("close", "Close the playback", partial(self._play, self._playback.close))
        self._bar.set_visibility(False)
        self._is_showing = False
        """Whether the controls are being set from the player's state, not by the user."""
        ui.timer(POSITION_S, self._show)

    def _show(self) -> None:
        playback, status = self._playback, self._playback.status
        self._bar.set_visibility(status is not None)
        if status is None:
            return
        playing = status["state"] == "playing"
        self._toggle.props["icon"] = "pause" if playing else "play_arrow"
        speed = status["speed"] or SPEEDS[-1]
        self._is_showing = True
        self._fused_again.set_value(playback.has_fused_again)
        self._speed.set_value(speed)
        self._is_showing = False
        # The height of the selected aircraft first.
        order = sorted(playback.aircraft, key=lambda key: (key != self._context.system_id, key))
        new = {
            "curves": [playback.aircraft[key].profile for key in order],
            "duration": status["duration_s"],
            "position": round(status["position_s"], 2),
            "playing": playing,
            "speed": speed,
        }
        for key, value in new.items():
            if self._slider.props.get(key) != value:
                self._slider.props[key] = value

    async def _play(self, act: Callable[..., Any], *args: Any, **params: Any) -> None:
        with notify_failure(self._context):
            self._context.check_may_change()
            if (answer := act(*args, **params)) is not None:
                await answer
            self._show()

    def _on_fused_again(self, event: Any) -> Awaitable[None] | None:
        name = self._playback.name
        if self._is_showing or not name:
            return None
        return open_playback(self._context, name, fused_again=event.value)

    async def _on_seek(self, event: GenericEventArguments) -> None:
        await self._play(self._playback.order, "seek", to=f"{float(event.args):.2f}")

    def _on_speed(self, event: Any) -> Awaitable[None] | None:
        if self._is_showing:
            return None
        return self._play(self._playback.order, "play.speed", speed=float(event.value))
