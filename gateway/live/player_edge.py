"""The player's edge: emits the frames of recordings when they are due.

While nothing plays, the state of the vehicles is repeated once a second, because ground stations
report a vehicle without heartbeats as lost.
"""

import asyncio
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

from gateway.live.control_socket import Verbs
from gateway.recordings.moment import parse_moment, time_us_of
from gateway.recordings.play import AS_FAST_AS_POSSIBLE, Player, PlayState, check_speed
from gateway.units import US_PER_S

BATCH: Final = 25
"""Maximum frames at once: a millisecond for four clients, after which others get their turn."""
LONGEST_WAIT_S: Final = 0.5
HOLD_US: Final = US_PER_S
"""Interval of the repetitions of the state."""
SEEKING: Final = "seeking"


@dataclass(frozen=True, slots=True)
class PlayerStatus:
    """Position and speed of the playback, as shown and sent by the control socket."""

    state: str
    position_s: float
    """Time since the start of the range."""
    duration_s: float
    time_us: int
    """Recorded civil time, µs since 1970."""
    speed: float | None
    """Factor to real time; None for as fast as possible."""
    loop: bool
    sent: int
    files: tuple[str, ...]
    remark: str = ""
    """Difference between the last request and its result; empty for none."""


class PlayerEdge:
    """Play recordings on the event loop: batches of frames to `emit`; `on_end` at their end.

    `repeat` gets the frames that show the state while nothing plays.
    """

    def __init__(
        self,
        player: Player,
        emit: Callable[[Iterable[bytes]], None],
        now_us: Callable[[], int],
        *,
        repeat: Callable[[Iterable[bytes]], None] = lambda _: None,
        files: Sequence[str] = (),
        on_end: Callable[[], None] = lambda: None,
    ) -> None:
        self._player = player
        self._emit = emit
        self._repeat = repeat
        self._emitted_us = 0
        self._clock = now_us
        self._files = tuple(files)
        self._on_end = on_end
        self._wanted_us: int | None = None
        self._timer: asyncio.TimerHandle | None = None

    def verbs(self) -> Verbs:
        """Return the handlers of the control socket; each returns the state."""
        return {
            "seek": self.seek,
            "play.pause": self.pause,
            "play.resume": self.resume,
            "play.stop": self.stop,
            "play.step": self.step,
            "play.speed": self.set_speed,
            "play.loop": self.set_loop,
            "play.status": self.status,
        }

    def start(self) -> None:
        """Start; needs a running event loop."""
        self._emitted_us = self._clock()
        self._turn()

    def close(self) -> None:
        """Cancel the timer; the owner of the recordings closes them."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def pause(self) -> PlayerStatus:
        """Stay at the present frame; heartbeats go on."""
        self._player.pause(self._clock())
        return self._turned()

    def resume(self) -> PlayerStatus:
        """Play on from the present frame at the same speed."""
        self._player.resume(self._clock())
        return self._turned()

    def stop(self) -> PlayerStatus:
        """End the playback."""
        self._player.pause(self._clock())
        self._on_end()
        return self.status()

    def step(self, count: int = 1) -> PlayerStatus:
        """Pause, and play the next frames."""
        self._emit(self._player.step(self._clock(), count))
        self._emitted_us = self._clock()
        return self._turned()

    def set_speed(self, speed: float | None) -> PlayerStatus:
        """Change the speed, None for the fastest; raises ValueError if it is out of range."""
        speed = AS_FAST_AS_POSSIBLE if speed is None else check_speed(speed)
        self._player.set_speed(speed, self._clock())
        return self._turned()

    def set_loop(self, on: bool) -> PlayerStatus:
        """Set whether to restart at the end."""
        self._player.loop = on
        return self.status()

    def seek(self, to: str) -> PlayerStatus:
        """Move to a moment, as soon as it is ready; see `parse_moment`, also for its error.

        A moment beyond the range becomes its begin or end, with a remark in the status.
        """
        player, moment = self._player, parse_moment(to)
        here_us = player.position_us if self._wanted_us is None else self._wanted_us
        wanted_us = time_us_of(moment, here_us if moment.relative else player.begin_us)
        remark = ""
        if not player.begin_us <= wanted_us <= player.end_us:
            wanted_us = min(max(wanted_us, player.begin_us), player.end_us)
            limit = "begin" if wanted_us == player.begin_us else "end"
            remark = f"{to} is beyond the recording: moved to its {limit}"
        self._wanted_us = wanted_us
        return replace(self._turned(), remark=remark)

    def status(self) -> PlayerStatus:
        """Return the present state."""
        player = self._player
        fastest = player.speed == AS_FAST_AS_POSSIBLE
        return PlayerStatus(
            state=player.state.value if self._wanted_us is None else SEEKING,
            position_s=(player.position_us - player.begin_us) / US_PER_S,
            duration_s=(player.end_us - player.begin_us) / US_PER_S,
            time_us=player.position_us,
            speed=None if fastest else player.speed,
            loop=player.loop,
            sent=player.sent,
            files=self._files,
        )

    def _turned(self) -> PlayerStatus:
        self._turn()
        return self.status()

    def _turn(self) -> None:
        """Emit the frames due and wait for the next; the work for a seek is done in between."""
        self.close()
        wanted_us = self._wanted_us
        if wanted_us is not None and self._player.prepare(wanted_us):
            self._player.seek(wanted_us, self._clock())
            self._wanted_us = None
        was_playing = self._player.state is PlayState.PLAYING
        if frames := self._player.poll(self._clock(), BATCH):
            self._emit(frames)
            self._emitted_us = self._clock()
        is_seeking, state = self._wanted_us is not None, self._player.state
        if is_seeking or state is not PlayState.PLAYING:
            self._hold()
        due_us, wait_s = self._player.next_due_us(), LONGEST_WAIT_S
        if is_seeking:
            wait_s = 0.0
        elif due_us is not None:
            wait_s = min(max((due_us - self._clock()) / US_PER_S, 0.0), LONGEST_WAIT_S)
        self._timer = asyncio.get_running_loop().call_later(wait_s, self._turn)
        if was_playing and state is PlayState.ENDED and not is_seeking:
            self._on_end()

    def _hold(self) -> None:
        """Repeat the state if nothing was emitted for a while."""
        if self._clock() - self._emitted_us >= HOLD_US:
            self._emitted_us = self._clock()
            self._repeat(self._player.held())
