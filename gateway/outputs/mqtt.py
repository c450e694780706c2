"""MQTT: the messages of all systems as JSON, each under its own topic.

    mqtt:tcp:HOST:1883  mqtt:tls:HOST:8883

`mavgate/<system>/<MESSAGE>` contains `{"header": ..., "message": ...}`, as sent by the WebSocket of
the REST API. `mavgate/status` is retained: `online`, or `offline` by the last will.
"""

import asyncio
from collections.abc import Iterable
from contextlib import suppress
from importlib import import_module
from typing import Any, Final

from gateway.extras import how_to_add
from gateway.hub.endpoint import Endpoint, EndpointKind
from gateway.hub.limits import RateLimit
from gateway.hub.transports.base import RETRY_US
from gateway.hub.transports.tls import MakeContext
from gateway.hub.transports.url_files import read_text
from gateway.outputs.carrier import TLS, target_of
from gateway.outputs.output import Output
from gateway.printable import reason_of
from gateway.units import US_PER_S
from gateway.wire.mavlink_json import json_from_frame
from gateway.wire.mavlink_splitter import MavFrame

MAX_WAITING: Final = 500
"""Maximum number of queued messages; while a broker is slow, further ones are dropped."""
MAX_KINDS: Final = 4096
"""Maximum number of kinds of messages with a rate limit; a greater number is forged."""
ANSWER_BYTES: Final = 2
"""Size of all answers of MQTT 3.1.1 to a client that only publishes (sections 3.2 to 3.7)."""
CONNECT_LIMIT_S: Final = 10.0
GOODBYE_LIMIT_S: Final = 1.0
MAX_LOGIN: Final = 512
"""Maximum size of a file with user and password."""
DEFAULT_TOPIC: Final = "mavgate"


class MqttOutput(Output):
    """All messages that pass the filters, of every system and component."""

    carriers = (EndpointKind.TCP, TLS)
    wanted_ids = frozenset()

    def __post_init__(self) -> None:
        """Start without rate limits."""
        super().__post_init__()
        self._limits: dict[bytes, RateLimit] = {}

    @classmethod
    def check(cls, endpoint: Endpoint) -> None:
        """Raise ValueError if the endpoint is invalid."""
        super().check(endpoint)
        with suppress(ModuleNotFoundError):
            # Imported while the settings are read; later it would delay the telemetry.
            import_module("aiomqtt")
        topic = endpoint.added.get("topic", DEFAULT_TOPIC)
        if not topic.strip("/") or not topic.isprintable() or set(topic) & set("+#$"):
            raise ValueError(f"topic {topic!r} is empty or contains +, # or $")

    def configure(self) -> None:
        """Read the options of the endpoint."""
        super().configure()
        self.topic = self.endpoint.added.get("topic", DEFAULT_TOPIC)
        self._limits = {}

    def transmit(self, frame: MavFrame) -> None:
        """Publish a message, unless the rate limit of its kind is exceeded."""
        if self.vehicle_id not in (0, frame.origin[0]) or self.carrier.state != "open":
            return
        if len(self._limits) >= MAX_KINDS:
            self._limits.clear()
        interval_us = round(self.interval_s * US_PER_S)
        limit = self._limits.setdefault(frame.key, RateLimit(interval_us))
        if limit.is_due(self.context.now_us()) and (found := json_from_frame(frame.data)):
            name, data, _ = found
            self.put((f"{self.topic}/{frame.origin[0]}/{name}", data))

    def compose(self, now_us: int) -> Iterable[bytes]:  # noqa: ARG002 -- of the base class
        """Return nothing: messages are published as they arrive."""
        return ()

    def put(self, message: Any) -> None:
        """Publish one message."""
        if self.carrier.send(message):
            self.counters.sent += 1
            self.counters.bytes_sent += len(message[1])
        else:
            self.counters.dropped += 1

    def _make_carrier(self) -> Any:
        return Broker(self.endpoint, self._tls_context)


class Broker:
    """A connection to a broker; `tls` makes the TLS context."""

    state, reason = "connecting", ""
    _retry_us = 0

    def __init__(self, endpoint: Endpoint, tls: MakeContext) -> None:
        self._kind, self._inner = target_of(endpoint.host, MqttOutput.carriers)
        self._login = endpoint.added.get("login", "")
        self._status = f"{endpoint.added.get('topic', DEFAULT_TOPIC)}/status"
        self._tls = tls
        self._waiting: asyncio.Queue[tuple[str, bytes]] = asyncio.Queue(MAX_WAITING)
        self._task: asyncio.Task[None] | None = None
        self.client: Any = None
        """Client of the present or last connection."""

    def tick(self, now_us: int) -> None:
        """Connect if there is no connection."""
        if self._task is None and now_us >= self._retry_us:
            self._retry_us = now_us + RETRY_US
            self._task = asyncio.get_running_loop().create_task(self._run())

    def send(self, message: tuple[str, bytes]) -> bool:
        """Queue a topic and its text; return whether the queue had room."""
        if self._waiting.full():
            return False
        self._waiting.put_nowait(message)
        return True

    def close(self) -> None:
        """Disconnect."""
        if self._task is not None:
            self._task.cancel()

    def fail(self, error: Exception) -> None:
        """Disconnect after an unexpected error; `tick` connects again."""
        self.state, self.reason = "unreachable", reason_of(error)
        self.close()

    async def _run(self) -> None:
        try:
            await self._connect()
        except ModuleNotFoundError:
            self.state, self.reason = "unreachable", how_to_add("this endpoint", "mqtt")
        except (OSError, ValueError) as error:
            self.state, self.reason = "unreachable", reason_of(error)
        finally:
            self._task = None

    async def _connect(self) -> None:
        # Imported here, as it belongs to an extra.
        import aiomqtt

        # Files, which a network drive may read slowly.
        loop = asyncio.get_running_loop()
        user, password = await loop.run_in_executor(None, self._read_login)
        tls = await loop.run_in_executor(None, self._tls) if self._kind == TLS else None
        self.client = client = aiomqtt.Client(
            self._inner.host,
            self._inner.port,
            username=user or None,
            password=password or None,
            tls_context=tls,
            will=aiomqtt.Will(self._status, "offline", qos=1, retain=True),
            timeout=CONNECT_LIMIT_S,
        )
        refused = _bound_packets(client)
        try:
            async with client:
                await client.publish(self._status, "online", qos=1, retain=True)
                self.state, self.reason = "open", ""
                try:
                    async with asyncio.TaskGroup() as tasks:
                        tasks.create_task(self._publish(client))
                        tasks.create_task(_watch(client))
                except asyncio.CancelledError:
                    # The broker does not send the last will after a regular disconnection.
                    last = client.publish(self._status, "offline", qos=1, retain=True)
                    await asyncio.wait_for(last, GOODBYE_LIMIT_S)
                    raise
        except (aiomqtt.MqttError, ExceptionGroup) as error:
            while not self._waiting.empty():
                self._waiting.get_nowait()
            cause = error.exceptions[0] if isinstance(error, ExceptionGroup) else error
            raise ConnectionError(refused[-1] if refused else str(cause)) from error

    async def _publish(self, client: Any) -> None:
        while True:
            topic, data = await self._waiting.get()
            await client.publish(topic, data)

    def _read_login(self) -> tuple[str, str]:
        """Return user and password; a file of any other form is not sent to the broker."""
        if not self._login:
            return "", ""
        text = read_text(self._login, MAX_LOGIN).strip()
        user, colon, password = text.partition(":")
        if not colon or not text.isprintable():
            raise OSError(f"{self._login} is not one line USER:PASSWORD")
        return user, password


def _bound_packets(client: Any) -> list[str]:
    """End a connection at a packet that is no answer, before it is read; return the reasons."""
    # Neither library has a bound, and a packet may have 256 MB.
    paho, refused = client._client, []  # noqa: SLF001
    receive = paho._sock_recv  # noqa: SLF001

    def receive_some(size: int) -> bytes:
        if size > ANSWER_BYTES:
            refused.append(f"the broker sends a packet of {size} bytes, which is no answer")
            raise ConnectionError(refused[-1])
        data: bytes = receive(size)
        return data

    paho._sock_recv = receive_some  # noqa: SLF001
    return refused


async def _watch(client: Any) -> None:
    """Raise MqttError when the connection ends."""
    async for _ in client.messages:
        pass
