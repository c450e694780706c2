"""Frames and messages under the keys of mavlink-server, which has no sites."""

from gateway.hub.transports.zenoh.client import Topic, ZenohClient
from gateway.hub.transports.zenoh.session import (
    JSON_IN,
    JSON_OUT,
    RAW_IN,
    RAW_OUT,
    RELIABLE_IDS,
    ROOT,
)
from gateway.wire.mavlink_json import frame_from_json, json_from_frame
from gateway.wire.mavlink_splitter import MavFrame


class ZenohRaw(ZenohClient):
    """Frames as they are, all under one key."""

    in_key = RAW_IN

    def topic_of(self, frame: MavFrame) -> Topic:  # noqa: ARG002
        """Return the one key."""
        return Topic(RAW_OUT)


class ZenohJson(ZenohClient):
    """Messages as JSON: each as a whole, by its name, and by its fields."""

    in_key = JSON_IN

    def frames_in(self, data: bytes) -> bytes:
        """Encode a received message; empty if it is malformed."""
        return frame_from_json(data)

    def transmit(self, frame: MavFrame) -> None:
        """Publish one message."""
        found = json_from_frame(frame.data) if self.state == "open" else None
        if found is None or self._connection is None:
            self.counters.dropped += 1
            return
        name, whole, fields = found
        system_id, component_id = frame.origin
        key = f"{ROOT}/{system_id}/{component_id}/{name}"
        self.publish(Topic(JSON_OUT), [whole], reliable=frame.message_id in RELIABLE_IDS)
        publishers = self._connection.publishers
        publishers.put_once(key, whole)
        for field, value in fields.items():
            publishers.put_once(f"{key}/{field}", value)
