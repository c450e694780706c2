"""Recording on command: acknowledged when the recorder has started, not when it was asked to.

| command       | recorder                        | answer                                   |
| ------------- | ------------------------------- | ---------------------------------------- |
| LOGGING_START | records already                 | ACCEPTED                                 |
| LOGGING_START | idle                            | IN_PROGRESS; then, as below              |
| LOGGING_STOP  | any                             | ACCEPTED; FAILED to all who wait         |
|               | has opened its files            | ACCEPTED to all who wait                 |
|               | cannot open them                | FAILED to all who wait, and why as text  |
|               | has not reported for 10 s       | FAILED to all who wait                   |

A start that failed stays pending: the recorder retries by itself, and announces when it succeeds.
"""

from typing import Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.units import US_PER_S
from gateway.vehicle.actions import Answer, RecordingRequest
from gateway.vehicle.services.commands import (
    ACCEPTED,
    FAILED,
    IN_PROGRESS,
    NOT_NOW,
    Command,
    CommandService,
    Explain,
    Outcome,
)

PATIENCE_US: Final = 10 * US_PER_S
MAX_WAITING: Final = 16
"""Ground stations that may wait for the recorder."""


class RecordingService:
    """Start and stop the recording.

    Parameters
    ----------
    explain : callable
        Announces to all why something was refused.
    """

    def __init__(self, explain: Explain) -> None:
        self._explain = explain
        self._recording = False
        self._waiting: dict[int, Command] = {}
        """The newest order to start of each client that waits for the outcome."""
        self._due_us: int | None = None

    def register(self, commands: CommandService) -> None:
        """Register the commands that are carried out here."""
        commands.register(mavlink.MAV_CMD_LOGGING_START, self._start)
        commands.register(mavlink.MAV_CMD_LOGGING_STOP, self._stop)

    def update(self, trouble: str, now_us: int, *, recording: bool) -> list[Answer]:
        """Note the state of the recorder.

        Parameters
        ----------
        trouble : str
            Why it cannot record although it should; empty if there is no problem.
        now_us : int
            Gateway clock.
        recording : bool
            Whether a recording runs.

        Returns
        -------
        list of Answer
        """
        self._recording = recording
        if not self._waiting:
            return []
        if recording:
            return self._end(ACCEPTED)
        if trouble:
            return self._end(FAILED) + self._explain(f"Cannot record: {trouble}", now_us)
        return []

    def poll(self, now_us: int) -> list[Answer]:
        """Report a failure when the recorder does not answer in time."""
        if self._due_us is None or now_us < self._due_us:
            return []
        return self._end(FAILED) + self._explain("Cannot record: no answer from the disk", now_us)

    def next_due_us(self) -> int | None:
        """Return when to give up."""
        return self._due_us

    def forget_client(self, client_id: int) -> None:
        """Forget the requests of a client that has gone."""
        self._waiting.pop(client_id, None)
        self._due_us = self._due_us if self._waiting else None

    def _start(self, command: Command, now_us: int) -> Outcome:
        order: list[Answer] = [RecordingRequest(start=True)]
        if self._recording:
            return ACCEPTED, order
        client_id = command.request.client_id
        if client_id not in self._waiting and len(self._waiting) >= MAX_WAITING:
            return NOT_NOW, []
        self._waiting[client_id] = command
        self._due_us = self._due_us or now_us + PATIENCE_US
        return IN_PROGRESS, order

    def _stop(self, _command: Command, _now_us: int) -> Outcome:
        return ACCEPTED, [*self._end(FAILED), RecordingRequest(start=False)]

    def _end(self, result: int) -> list[Answer]:
        acks: list[Answer] = [command.ack(result) for command in self._waiting.values()]
        self._waiting.clear()
        self._due_us = None
        return acks
