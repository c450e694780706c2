"""Lock-step: every board and every model on one time line, in picoseconds.

All boards run to the same moment, the next event of a model or `STEP_PS` on, whichever is sooner.
A board's action may then schedule an event behind that moment only: the radio's 130 us from the
order to send to the first bit is the look-ahead that makes its timing exact.
"""

import ctypes
import heapq
import itertools
from collections.abc import Callable
from typing import Final

from firmware.rig.mcu import Mcu, library

PS_PER_S: Final = 1_000_000_000_000
PS_PER_US: Final = 1_000_000
STEP_PS: Final = 100 * PS_PER_US
_NEVER_PS: Final = 2**63 - 1


class Bench:
    """The time line: boards, and events of the models."""

    def __init__(self) -> None:
        self.now_ps = 0
        self.chips: list[Mcu] = []
        self.after_step: list[Callable[[], None]] = []
        """Called after events, and after a step in which a board's serial line has changed."""
        self._events: list[tuple[int, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self._next_ps = ctypes.c_int64(_NEVER_PS)
        """Time of the first event, which the shim reads before every step."""

    def at(self, time_ps: int, action: Callable[[], None]) -> None:
        """Have `action` called at a time; if that is past, at once."""
        heapq.heappush(self._events, (time_ps, next(self._order), action))
        self._next_ps.value = self._events[0][0]

    def run_until(self, time_ps: int) -> None:
        """Run boards and models to this time."""
        run, next_event, events = library().boards_run, ctypes.byref(self._next_ps), self._events
        boards = (ctypes.c_void_p * len(self.chips))(*(chip.board for chip in self.chips))
        while self.now_ps < time_ps:
            now_ps = run(boards, len(boards), self.now_ps, time_ps, STEP_PS, next_event)
            self.now_ps = now_ps
            for chip in self.chips:
                chip.check()
            while events and events[0][0] <= now_ps:
                action = heapq.heappop(events)[2]
                self._next_ps.value = events[0][0] if events else _NEVER_PS
                action()
            for action in self.after_step:
                action()

    def run_for(self, seconds: float) -> None:
        """Run boards and models on."""
        self.run_until(self.now_ps + round(seconds * PS_PER_S))
