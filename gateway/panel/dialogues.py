"""What the panel asks of aircraft in more than one message: parameters, their meaning, calibration.

One for the whole panel, so that every open page sees the same, and a page that is loaded anew finds
a calibration that runs.
"""

import asyncio
from collections.abc import Callable
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.edges.clock import GatewayClock
from gateway.panel.state.dialogue.calibration_run import CalibrationRun, CalibrationStep, RunState
from gateway.panel.state.dialogue.file_client import FileClient
from gateway.panel.state.dialogue.parameter_client import AUTOPILOT, ListState, ParameterClient
from gateway.panel.state.dialogue.parameter_meta import (
    GENERAL_PATHS,
    ParameterMeta,
    parameter_path,
    parse_parameters,
)
from gateway.panel.state.fleet_picture import FleetPicture

POLL_S: Final = 0.05
SAMPLES_US: Final = 20_000


class Dialogue:
    """The dialogue with one aircraft."""

    def __init__(self, system_id: int) -> None:
        self.parameters = ParameterClient(system_id)
        self.files = FileClient(system_id)
        self.metas: dict[str, ParameterMeta] = {}
        """What the parameters mean, as far as the aircraft tells."""
        self.calibration: CalibrationRun | None = None
        """The newest one, be it over or not."""
        self.before: dict[str, float] = {}
        """All parameters as they were when it began."""

    def load(self, now_us: int) -> list[Any]:
        """Ask for the parameters and what they mean; returns what is to be sent."""
        self.files.refused.clear()
        found = self.parameters.load(now_us)
        return found if self.metas else found + self.files.read(GENERAL_PATHS[0], now_us)

    @property
    def unanswered(self) -> CalibrationStep | None:
        """The step that was calibrated and neither stored nor undone yet."""
        run = self.calibration
        return run.step if run is not None and run.state is RunState.DONE else None

    def calibrate(self, step: CalibrationStep, now_us: int) -> list[Any]:
        """Begin a calibration; returns what is to be sent."""
        if self.unanswered is None:
            self.before = {name: entry.value for name, entry in self.parameters.entries.items()}
        self.calibration = CalibrationRun(self.parameters.system_id, step, now_us)
        return [*self.ask_for_samples(), self.calibration.start_message()]

    def ask_for_samples(self) -> list[Any]:
        """Have the sensors told often enough to be drawn and fused; returns what is to be sent."""
        return [
            mavlink.MAVLink_command_long_message(
                self.parameters.system_id,
                AUTOPILOT,
                mavlink.MAV_CMD_SET_MESSAGE_INTERVAL,
                0,
                mavlink.MAVLINK_MSG_ID_HIGHRES_IMU,
                SAMPLES_US,
                *(0.0,) * 5,
            )
        ]

    def take(self, message: Any, now_us: int) -> list[Any]:
        """Take in one message of the aircraft; returns what is to be sent."""
        self.parameters.take(message, now_us)
        if self.calibration is not None:
            self.calibration.take(message, now_us)
        return self.files.take(message, now_us) + self._follow_files(now_us)

    def poll(self, now_us: int) -> list[Any]:
        """Do what is due by time; returns what is to be sent."""
        if self.calibration is not None:
            self.calibration.poll(now_us)
        found = self.parameters.poll(now_us) + self.files.poll(now_us)
        return found + self._follow_files(now_us)

    def _follow_files(self, now_us: int) -> list[Any]:
        """Go from the general metadata file to the parameters' own."""
        if self.metas or self.files.busy:
            return []
        files, found = self.files.files, list[Any]()
        general = next((files[path] for path in GENERAL_PATHS if path in files), None)
        if general is None:
            if (
                GENERAL_PATHS[0] in self.files.refused
                and GENERAL_PATHS[1] not in self.files.refused
            ):
                found = self.files.read(GENERAL_PATHS[1], now_us)
            return found
        path = parameter_path(general)
        if path is None or path in self.files.refused:
            return []
        if path in files:
            self.metas = parse_parameters(files[path])
            return []
        return self.files.read(path, now_us)


class Dialogues:
    """The dialogues with all aircraft.

    Parameters
    ----------
    fleet : FleetPicture
        Hands on what they say.
    send : callable
        Sends one MAVLink message.
    clock : GatewayClock
        The panel's.
    """

    def __init__(
        self, fleet: FleetPicture, send: Callable[[Any], None], clock: GatewayClock
    ) -> None:
        self._all: dict[int, Dialogue] = {}
        self._send = send
        self._clock = clock
        self._task: asyncio.Task[None] | None = None
        fleet.listen(self._take)
        fleet.on_forget(self._forget)

    def start(self) -> None:
        """Begin to ask again for what does not come; needs a running event loop."""
        self._task = asyncio.get_running_loop().create_task(self._poll())

    def close(self) -> None:
        """End that."""
        if self._task is not None:
            self._task.cancel()

    def of(self, system_id: int) -> Dialogue:
        """Return the dialogue with an aircraft."""
        return self._all.setdefault(system_id, Dialogue(system_id))

    def load(self, system_id: int, *, anew: bool = False) -> None:
        """Ask for an aircraft's parameters, unless they are known or being asked for."""
        dialogue = self.of(system_id)
        if anew or dialogue.parameters.state in (ListState.UNKNOWN, ListState.FAILED):
            self._send_all(dialogue.load(self._clock()))

    def change(self, system_id: int, name: str, value: float) -> None:
        """Set a parameter; raises ValueError for nonsense."""
        self._send_all(self.of(system_id).parameters.change(name, value, self._clock()))

    def calibrate(self, system_id: int, step: CalibrationStep) -> None:
        """Begin a calibration."""
        self._send_all(self.of(system_id).calibrate(step, self._clock()))

    def ask_for_samples(self, system_id: int) -> None:
        """Have an aircraft's sensors told often enough to be fused."""
        self._send_all(self.of(system_id).ask_for_samples())

    def cancel(self, system_id: int) -> None:
        """Break a calibration off."""
        run = self.of(system_id).calibration
        if run is not None:
            self._send(run.cancel_message())

    def _forget(self, system_id: int) -> None:
        self._all.pop(system_id, None)

    def _take(self, system_id: int, message: Any, now_us: int) -> None:
        dialogue = self._all.get(system_id)
        if dialogue is not None:
            self._send_all(dialogue.take(message, now_us))

    async def _poll(self) -> None:
        while True:
            await asyncio.sleep(POLL_S)
            for dialogue in tuple(self._all.values()):
                self._send_all(dialogue.poll(self._clock()))

    def _send_all(self, messages: list[Any]) -> None:
        for message in messages:
            self._send(message)
