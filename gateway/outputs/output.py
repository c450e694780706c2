"""Base of the outputs: states of vehicles, formatted at a rate and passed to a carrier.

An output is a client of the hub: the filters of its endpoint select the frames, and thereby the
systems, that it receives. It only subscribes to messages that it reads.
"""

import asyncio
import ssl
from collections.abc import Collection, Iterable
from dataclasses import replace
from typing import Any, ClassVar

from gateway.clock import unix_time_us
from gateway.hub.endpoint import NO_MESSAGES, Endpoint, number_from
from gateway.hub.stats import ClientStats
from gateway.hub.transports.base import Client
from gateway.hub.transports.tls import client_context
from gateway.outputs.carrier import Carrier, target_of
from gateway.vehicle_state.antenna import HOME, AntennaStation, station_from
from gateway.vehicle_state.newest import STATE_IDS, NewestState, NewestVehicles
from gateway.wire.mavlink_splitter import MavFrame

MIN_RATE_HZ, MAX_RATE_HZ = 0.01, 50.0


class Output(Client):
    """An endpoint that sends the states of vehicles in its own format, and receives no data."""

    may_return = False
    carriers: ClassVar[Collection[str]] = ()
    """Carriers that are allowed in its URL."""
    default_rate_hz: ClassVar[float] = 1.0
    wanted_ids: ClassVar[frozenset[int]] = STATE_IDS
    """Ids of the messages that it reads; empty for all."""
    _timer: asyncio.TimerHandle | None = None
    unix_us = staticmethod(unix_time_us)
    """Function that returns the civil time."""

    def __post_init__(self) -> None:
        """Restrict the filter of the endpoint to messages that are read; start disconnected."""
        self.endpoint = self._narrowed(self.endpoint)
        super().__post_init__()
        self.vehicles = NewestVehicles()
        self.configure()
        self.carrier: Any = self._make_carrier()

    @classmethod
    def check(cls, endpoint: Endpoint) -> None:
        """Raise ValueError if the endpoint is invalid."""
        target_of(endpoint.host, cls.carriers)
        _rate_hz(endpoint, cls.default_rate_hz)
        _vehicle_id(endpoint)
        station_of(endpoint)

    def configure(self) -> None:
        """Read the options of the endpoint."""
        self.interval_s = 1.0 / _rate_hz(self.endpoint, self.default_rate_hz)
        self.vehicle_id = _vehicle_id(self.endpoint)

    def compose(self, now_us: int) -> Iterable[bytes]:
        """Return the messages that are due; called at the rate of the endpoint."""
        raise NotImplementedError

    def transmit(self, frame: MavFrame) -> None:
        """Process one frame."""
        self.vehicles.feed(frame, self.context.now_us())

    def tick(self, now_us: int) -> None:
        """Open the carrier if it is closed, and start the timer."""
        self.carrier.tick(now_us)
        if self._timer is None:
            self._timer = self.loop.call_later(self.interval_s, self._turn)

    def reconfigure(self, endpoint: Endpoint) -> None:
        """Apply changed options of the same endpoint."""
        super().reconfigure(self._narrowed(endpoint))
        self.configure()

    def close(self) -> None:
        """Close the carrier, and stop the timer."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self.carrier.close()

    def fail(self, error: Exception) -> None:
        """Close after an unexpected error; `tick` opens the carrier again."""
        self.close()
        self.carrier.fail(error)

    def put(self, data: bytes) -> None:
        """Send one message now."""
        self.carrier.send(data)

    def stats(self, *args: Any, **kwargs: Any) -> ClientStats:
        """Return the present figures, with the state of the carrier."""
        found = super().stats(*args, **kwargs)
        carrier = self.carrier
        return replace(found, state=carrier.state, reason=carrier.reason, receives=False)

    def heard(self, now_us: int) -> dict[int, NewestState]:
        """Return the selected vehicle, or all recently received ones, by system id."""
        heard = self.vehicles.heard(now_us).items()
        return {key: state for key, state in heard if self.vehicle_id in (0, key)}

    def chosen(self, now_us: int) -> NewestState | None:
        """Return the selected vehicle, by default the one with the lowest system id."""
        return next(iter(self.heard(now_us).values()), None)

    def position_unix_us(self, state: NewestState, now_us: int) -> int:
        """Return the civil time of a vehicle's position, µs since 1970."""
        return self.unix_us() - (now_us - state.position_us)

    def _turn(self) -> None:
        # First, so that the timer continues after an exception below.
        self._timer = self.loop.call_later(self.interval_s, self._turn)
        for data in self.compose(self.context.now_us()):
            self.put(data)

    def _make_carrier(self) -> Any:
        return Carrier(self, self.carriers, self._tls_context)

    def _tls_context(self) -> ssl.SSLContext:
        given = self.endpoint.added
        authority = given.get("authority") or self.context.settings.tls_authority
        return client_context(authority, given.get("certificate", ""), given.get("key", ""))

    def _narrowed(self, endpoint: Endpoint) -> Endpoint:
        """Return the endpoint with a filter that passes only the messages that are read."""
        if not self.wanted_ids:
            return endpoint
        allow = self.wanted_ids & endpoint.allow if endpoint.allow else self.wanted_ids
        return replace(endpoint, allow=allow or frozenset({NO_MESSAGES}))


def _rate_hz(endpoint: Endpoint, default_hz: float) -> float:
    text = endpoint.added.get("rate")
    try:
        rate_hz = default_hz if text is None else float(text)
    except ValueError:
        raise ValueError(f"rate {text!r} is not a number in Hz") from None
    if not MIN_RATE_HZ <= rate_hz <= MAX_RATE_HZ:
        raise ValueError(f"rate {text!r} is not {MIN_RATE_HZ} to {MAX_RATE_HZ} Hz")
    return rate_hz


def station_of(endpoint: Endpoint) -> AntennaStation:
    """Return the antenna station in the option `station`; raises ValueError if it is invalid."""
    return station_from(endpoint.added.get("station", HOME))


def _vehicle_id(endpoint: Endpoint) -> int:
    """Return the system id of the selected vehicle; 0 for any."""
    text = endpoint.added.get("vehicle")
    return 0 if text is None else number_from(text, "vehicle", 1, 249)
