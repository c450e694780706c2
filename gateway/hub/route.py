"""The cached routes of frames: the clients that get one kind of frame from one client."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final, Protocol

import numpy as np

from gateway.compiled import address_of
from gateway.hub import forwarding_step as step
from gateway.hub.forwarding import Forwarding
from gateway.hub.limits import RateLimit
from gateway.hub.routing_table import SystemPath
from gateway.hub.stats import ClientCounters
from gateway.wire.mavlink_messages import CRC_EXTRA, ids_of
from gateway.wire.mavlink_splitter import KEY_SIZE_V2, MavFrame, frame_of

EXAMINED: Final = ids_of("RADIO_STATUS", "AVAILABLE_MODES")
"""Messages of which Python examines each, not only the newest."""
OnForeign = Callable[[Sequence[bytes]], None]
"""Called with frames of other systems that are forwarded, in their order."""


class Taker(Protocol):
    """The part of a client that a route uses."""

    memory: step.ClientState
    counters: ClientCounters

    @property
    def is_direct(self) -> bool:
        """Whether the compiled step may send to it."""

    @property
    def send(self) -> Callable[[MavFrame], None]:
        """The function that sends it a frame."""

    def transmit(self, frame: MavFrame) -> None:
        """Send a frame unchanged."""

    def send_rest(self, frames: Iterable[bytes], number: int, part: int) -> None:
        """Send the frames that the compiled step did not send."""


Target = tuple[Taker, RateLimit | None, Callable[[MavFrame], None] | None]
"""A client of a route, its limit, and the function that sends to it; None for its own."""


class Targets:
    """The clients of some routes: those that the compiled step sends to, and others with limits."""

    def __init__(self, targets: Iterable[Target]) -> None:
        self.forwarded = 0
        """Frames sent by `send` since the last call of `settle`."""
        self.direct: list[Taker] = []
        self.others: list[tuple[Callable[[MavFrame], None], RateLimit | None]] = []
        for client, limit, send in targets:
            if limit is None and send is None and client.is_direct:
                self.direct.append(client)
            else:
                self.others.append((send or client.send, limit))
        clients = [address_of(client.memory) for client in self.direct]
        memory = np.array([len(clients), bool(self.others), 0, 0, *clients])
        self._counts: Any = step.TargetCounts.from_buffer(memory)  # type: ignore[attr-defined]
        self.address = address_of(memory)

    def settle(self) -> int:
        """Count what the compiled step has sent; return the number of frames sent otherwise."""
        counts = self._counts
        if frames := counts.sent:
            for client in self.direct:
                client.counters.sent += frames
                client.counters.bytes_sent += counts.sent_size
            counts.sent = counts.sent_size = 0
        forwarded, self.forwarded = self.forwarded, 0
        return forwarded

    def send(self, frame: MavFrame, now_us: int) -> None:
        """Send a frame to every client."""
        self.forwarded += 1
        for client in self.direct:
            client.transmit(frame)
        self._send_others(frame, now_us)

    def finish(self, run: list[bytes], failures: list[step.Failure], now_us: int) -> None:
        """Complete the forwarding of a run: the part that the compiled step leaves to Python."""
        for each in failures:
            self.direct[each.index].send_rest(run[each.sent :], each.number, each.part)
        if self.others:
            for data in run:
                self._send_others(frame_of(data), now_us)

    def _send_others(self, frame: MavFrame, now_us: int) -> None:
        for send, limit in self.others:
            if limit is None or limit.is_due(now_us):
                send(frame)


class Route:
    """The clients that get one kind of frame from one client.

    The client `source_id` brings the frames of a system by `path`. `rejects` returns whether a
    frame is dropped as a copy, `on_foreign` is called with each forwarded one.
    """

    def __init__(
        self,
        message_id: int,
        targets: Targets,
        source_id: int,
        path: SystemPath,
        rejects: Callable[[MavFrame, int], bool] | None,
        on_foreign: OnForeign | None,
    ) -> None:
        self.message_id = message_id
        self.frames = self.size = 0
        self.targets = targets
        self._source_id = source_id
        self._path = path
        self._rejects = rejects
        self._on_foreign = on_foreign
        self.is_examined = False
        """Whether the router examines each frame, such as heartbeats, before it is forwarded."""
        self._row: int | None = None
        """Its row in the compiled step."""

    def enter(self, forwarding: Forwarding, key: bytes) -> None:
        """Let the compiled step forward such frames, unless it needs more than their headers."""
        seed = CRC_EXTRA.get(self.message_id)
        is_header_enough = self._rejects is None and self.message_id not in EXAMINED
        if (
            seed
            and is_header_enough
            and len(key) == KEY_SIZE_V2
            and len(self.targets.direct) < step.MAX_FAILED
        ):
            path = self._path
            self._row = forwarding.enter(
                self._source_id,
                key,
                seed[0],
                self.targets.address,
                address_of(path.stream),
                address_of(path.heard),
            )

    @property
    def is_compiled(self) -> bool:
        """Whether the compiled step forwards such frames."""
        return self._row is not None

    def leave(self, forwarding: Forwarding, key: bytes) -> None:
        """Remove the route from the compiled step."""
        if self._row is not None:
            forwarding.leave(self._source_id, key, self._row)
            self._row = None

    def forward(self, frame: MavFrame, now_us: int, *, is_checked: bool = False) -> None:
        """Send a frame to every client; a rejected one to none."""
        self._path.heard_us = now_us
        if not is_checked:
            if self._rejects is None:
                self._path.stream.accept(frame.sequence, self._source_id, now_us)
            elif self._rejects(frame, now_us):
                return
        self.frames += 1
        self.size += len(frame.data)
        self.targets.send(frame, now_us)
        if self._on_foreign is not None:
            self._on_foreign((frame.data,))

    def settle(self, forwarding: Forwarding) -> tuple[int, int]:
        """Return the frames and bytes that were forwarded since the last call."""
        frames, size = (0, 0) if self._row is None else forwarding.settle(self._row)
        frames, size = self.frames + frames, self.size + size
        self.frames = self.size = 0
        return frames, size
