"""Messages that other packages add to every vehicle's telemetry."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from gateway.records import BaroSample, GpsFix, ImuSample, NavState


@dataclass(frozen=True, slots=True)
class NewestRecords:
    """The newest records of one aircraft, each None until the first has come."""

    state: NavState | None
    sample: ImuSample | None
    baro: BaroSample | None
    fix: GpsFix | None


@dataclass(frozen=True, slots=True)
class AddedMessage:
    """One message, its rate, and the function that builds it."""

    message_id: int
    rate_hz: float
    build: Callable[[NewestRecords], Any]
    """Returns a message of pymavlink, or None while there is nothing to send."""


ADDED_MESSAGES: Final[dict[int, AddedMessage]] = {}


def add_message(
    message_id: int, rate_hz: float, build: Callable[[NewestRecords], Any]
) -> AddedMessage:
    """Add a message to every vehicle created from now on.

    Parameters
    ----------
    message_id : int
        Of the `common` dialect, so that recordings and routers know it.
    rate_hz : float
        How often it is sent; a client may request another rate, as for any message.
    build : callable
        Builds it from the newest records.

    Returns
    -------
    AddedMessage

    Raises
    ------
    ValueError
        If the rate is not positive, or the message was added before.
    """
    if not rate_hz > 0.0:
        raise ValueError(f"rate of message {message_id} is {rate_hz} Hz; it must be positive")
    if message_id in ADDED_MESSAGES:
        raise ValueError(f"message {message_id} is added twice")
    added = ADDED_MESSAGES[message_id] = AddedMessage(message_id, rate_hz, build)
    return added
