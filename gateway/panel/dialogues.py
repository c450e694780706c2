"""Exchanges of several messages with aircraft: parameters, metadata, calibration.

All pages share the dialogue with an aircraft, so that they show the same, and a reloaded page finds
a running calibration.
"""

import asyncio
from collections.abc import Callable
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.clock import GatewayClock
from gateway.panel.state import parameters
from gateway.panel.state.calibration import CalibrationRun, RunState
from gateway.panel.state.commands import command_long
from gateway.panel.state.fleet import FleetState
from gateway.panel.uplink import LoopTask
from gateway.sensing.calibrating import CalibrationStep

POLL_S: Final = 0.05
SAMPLES_US: Final = 20_000


class Dialogue:
    """The dialogue with one aircraft; that with system 0, which is none, sends nothing."""

    def __init__(
        self, system_id: int, send: Callable[[Any], object], now_us: Callable[[], int]
    ) -> None:
        self._send, self._now_us = send if system_id else lambda _: None, now_us
        self.parameters = parameters.ParameterClient(system_id)
        self.files = parameters.FileClient(system_id)
        self.metas: dict[str, parameters.ParameterMeta] = {}
        """Metadata of the parameters, as far as the aircraft provides it."""
        self._reading: str | None = None
        """Metadata file that is being read."""
        self.calibration: CalibrationRun | None = None
        """The newest calibration, running or finished."""
        self.before: dict[str, float] = {}
        """All parameters at the start of the calibration."""

    def load(self, *, again: bool = False) -> None:
        """Request parameters and metadata; known or requested ones only with `again`."""
        if not again and self.parameters.state not in (
            parameters.ListState.UNKNOWN,
            parameters.ListState.FAILED,
        ):
            return
        self._send_all(self.parameters.load(self._now_us()))
        if not self.metas:
            self._read(parameters.GENERAL_PATHS[0])

    def change(self, name: str, value: float) -> None:
        """Set a parameter; raises ValueError for an invalid one."""
        self._send_all(self.parameters.change(name, value, self._now_us()))

    @property
    def unanswered(self) -> CalibrationStep | None:
        """The calibrated step that is neither stored nor undone yet."""
        run = self.calibration
        return run.step if run is not None and run.state is RunState.DONE else None

    def calibrate(self, step: CalibrationStep) -> None:
        """Start a calibration."""
        if self.unanswered is None:
            self.before = self.parameters.values
        self.calibration = CalibrationRun(self.parameters.system_id, step, self._now_us())
        self.ask_for_samples()
        self._send(self.calibration.start_message())

    def cancel(self) -> None:
        """Cancel the calibration."""
        if self.calibration is not None:
            self._send(self.calibration.cancel_message())

    def ask_for_samples(self) -> None:
        """Request sensor rates high enough for drawing and fusing."""
        system_id, number = self.parameters.system_id, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
        self._send(command_long(system_id, number, mavlink.MAVLINK_MSG_ID_HIGHRES_IMU, SAMPLES_US))

    def handle(self, message: Any, now_us: int) -> None:
        """Handle one message of the aircraft."""
        self.parameters.handle(message, now_us)
        if self.calibration is not None:
            self.calibration.handle(message, now_us)
        self._send_all(self.files.handle(message, now_us))
        self._follow_files()

    def poll(self) -> None:
        """Send what is due by time."""
        now_us = self._now_us()
        if self.calibration is not None:
            self.calibration.poll(now_us)
        self._send_all(self.parameters.poll(now_us) + self.files.poll(now_us))
        self._follow_files()

    def _read(self, path: str) -> None:
        self._reading = path
        self._send_all(self.files.read(path, self._now_us()))

    def _send_all(self, messages: list[Any]) -> None:
        for message in messages:
            self._send(message)

    def _follow_files(self) -> None:
        """Read the general metadata file, then that of the parameters; each is parsed only once."""
        path, following = self._reading, None
        if path is None or self.files.busy:
            return
        content = self.files.content
        if content is None:
            following = parameters.GENERAL_PATHS[1] if path == parameters.GENERAL_PATHS[0] else None
        elif path in parameters.GENERAL_PATHS:
            following = parameters.parameter_path(content)
        else:
            self.metas = parameters.parse_parameters(content)
        self._reading = None
        if following is not None:
            self._read(following)


class Dialogues(LoopTask):
    """The dialogues with all aircraft."""

    def __init__(
        self, fleet: FleetState, send: Callable[[Any], object], clock: GatewayClock
    ) -> None:
        self._all: dict[int, Dialogue] = {}
        self._send = send
        self._clock = clock
        fleet.listen(self._handle)
        fleet.on_discard(self._discard)

    def of(self, system_id: int) -> Dialogue:
        """Return the dialogue with an aircraft."""
        return self._all.setdefault(system_id, Dialogue(system_id, self._send, self._clock))

    def _discard(self, system_id: int) -> None:
        self._all.pop(system_id, None)

    def _handle(self, system_id: int, message: Any, now_us: int) -> None:
        if (dialogue := self._all.get(system_id)) is not None:
            dialogue.handle(message, now_us)

    async def _run(self) -> None:
        while True:
            await asyncio.sleep(POLL_S)
            for dialogue in tuple(self._all.values()):
                dialogue.poll()
