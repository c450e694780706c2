"""The player's edge: emits the frames of recordings when they are due."""

import asyncio
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from gateway.recordings.play import AS_FAST_AS_POSSIBLE, Player, PlayState, check_speed
from gateway.units import US_PER_S

BATCH: Final = 25
"""Frames at once: to four clients a millisecond, after which others get their turn."""
LONGEST_WAIT_S: Final = 0.5
SEEKING: Final = "seeking"


@dataclass(frozen=True, slots=True)
class PlayerStatus:
    """State of the player."""

    state: str
    position_s: float
    """Since the start of the range."""
    duration_s: float
    time_us: int
    """Recorded civil time, µs since 1970."""
    speed: float | None
    """None for as fast as possible."""
    loop: bool
    sent: int
    files: tuple[str, ...]


class PlayerEdge:
    """Play recordings on the event loop.

    Parameters
    ----------
    player : Player
        Decides what is due when.
    emit : callable
        Called with each batch of frames.
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
        """Start; needs a running event loop."""
        self._turn()

    def close(self) -> None:
        """Stop."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def pause(self) -> None:
        """Pause."""
        self._player.pause(self._clock())
        self._turn()

    def resume(self) -> None:
        """Resume."""
        self._player.resume(self._clock())
        self._turn()

    def step(self, count: int = 1) -> None:
        """Pause, and play the next frames."""
        self._emit(self._player.step(self._clock(), count))
        self._turn()

    def set_speed(self, speed: float) -> None:
        """Change the speed; raises ValueError if it is out of range."""
        self._player.set_speed(check_speed(speed), self._clock())
        self._turn()

    def set_loop(self, loop: bool) -> None:
        """Set whether to restart at the end."""
        self._player.loop = loop

    def seek(self, offset_s: float, *, relative: bool = False) -> None:
        """Move to an offset from the start of the range, or from here."""
        player = self._player
        here_us = player.position_us if self._wanted_us is None else self._wanted_us
        base_us = here_us if relative else player.begin_us
        self.seek_time(base_us + round(offset_s * US_PER_S))

    def seek_time(self, time_us: int) -> None:
        """Move to a recorded civil time in µs since 1970, as soon as it is ready."""
        self._wanted_us = time_us
        self._turn()

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
