"""The player's edge: hands the frames of recordings on when they are due."""

import asyncio
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from gateway.flightlog.playback import AS_FAST_AS_POSSIBLE, Player, PlayState, check_speed
from gateway.units import US_PER_S

BATCH: Final = 200
"""Frames in one go: about a millisecond, after which others get their turn."""
LONGEST_WAIT_S: Final = 0.5
SEEKING: Final = "seeking"


@dataclass(frozen=True, slots=True)
class PlayerStatus:
    """What the player does."""

    state: str
    position_s: float
    """Since the begin of the range."""
    duration_s: float
    time_us: int
    """Recorded civil time, µs since 1970."""
    speed: float | None
    """None for as fast as possible."""
    loop: bool
    sent: int
    files: tuple[str, ...]


class PlayerEdge:
    """Plays on the event loop.

    Parameters
    ----------
    player : Player
        What is due when.
    emit : callable
        Given each batch of frames.
    now_us : callable
        The gateway clock.
    files : sequence of str
        Names to show.
    on_end : callable, optional
        Called when the end is reached.
    """

    def __init__(
        self,
        player: Player,
        emit: Callable[[Iterable[bytes]], None],
        now_us: Callable[[], int],
        *,
        files: Sequence[str] = (),
        on_end: Callable[[], None] | None = None,
    ) -> None:
        self._player = player
        self._emit = emit
        self._clock = now_us
        self._files = tuple(files)
        self._on_end = on_end
        self._wanted_us: int | None = None
        self._timer: asyncio.TimerHandle | asyncio.Handle | None = None

    def start(self) -> None:
        """Begin; needs a running event loop."""
        self._turn()

    def close(self) -> None:
        """Stop."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def pause(self) -> None:
        """Hold."""
        self._player.pause(self._clock())
        self._turn()

    def resume(self) -> None:
        """Go on."""
        self._player.resume(self._clock())
        self._turn()

    def step(self, count: int = 1) -> None:
        """Pause, and play the next frames."""
        self._emit(self._player.step(self._clock(), count))
        self._turn()

    def set_speed(self, speed: float) -> None:
        """Go on at another speed; raises ValueError for one that is not offered."""
        self._player.set_speed(check_speed(speed), self._clock())
        self._turn()

    def set_loop(self, loop: bool) -> None:
        """Start anew at the end, or not."""
        self._player.loop = loop

    def seek(self, offset_s: float, *, relative: bool = False) -> None:
        """Move to an offset from the start of the range, or from here."""
        player = self._player
        here_us = player.position_us if self._wanted_us is None else self._wanted_us
        base_us = here_us if relative else player.begin_us
        self.seek_time(base_us + round(offset_s * US_PER_S))

    def seek_time(self, time_us: int) -> None:
        """Move to a recorded civil time in µs since 1970, as soon as that is ready."""
        self._wanted_us = time_us
        self._turn()

    def status(self) -> PlayerStatus:
        """Describe this moment."""
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

    def _turn(self) -> None:
        """Hand on what is due and wait for the next; what a seek needs is done in between."""
        self.close()
        wanted_us = self._wanted_us
        if wanted_us is not None and self._player.prepare(wanted_us):
            self._player.seek(wanted_us, self._clock())
            self._wanted_us = None
        was_playing = self._player.state is PlayState.PLAYING
        if frames := self._player.poll(self._clock(), BATCH):
            self._emit(frames)
        loop, due_us = asyncio.get_running_loop(), self._player.next_due_us()
        if self._wanted_us is not None:
            self._timer = loop.call_soon(self._turn)
        elif due_us is not None:
            wait_s = (due_us - self._clock()) / US_PER_S
            if wait_s <= 0:
                self._timer = loop.call_soon(self._turn)
            else:
                self._timer = loop.call_later(min(wait_s, LONGEST_WAIT_S), self._turn)
        elif was_playing and self._player.state is PlayState.ENDED and self._on_end is not None:
            self._on_end()
