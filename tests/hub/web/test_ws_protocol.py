"""One WebSocket connection, without a socket: bytes, whole and in pieces, and the answers."""

import random
import struct

import pytest
from wsproto.frame_protocol import CloseReason

from gateway.hub.transports.ws_protocol import MAX_MESSAGE, WsInput, WsServer

REQUEST = (
    b"GET / HTTP/1.1\r\nHost: 127.0.0.1:56781\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
)
MASK = bytes((1, 2, 3, 4))


def masked(opcode: int, payload: bytes, *, fin: bool = True, rsv: int = 0) -> bytes:
    """Write a client's frame as RFC 6455 section 5.2 draws it."""
    head = bytes((fin << 7 | rsv << 4 | opcode,))
    size = len(payload)
    if size < 126:
        head += bytes((0x80 | size,))
    elif size < 65536:
        head += struct.pack("!BH", 0x80 | 126, size)
    else:
        head += struct.pack("!BQ", 0x80 | 127, size)
    return head + MASK + bytes(byte ^ MASK[n % 4] for n, byte in enumerate(payload))


def opened() -> WsServer:
    server = WsServer(lambda origin: False)
    found = server.feed(REQUEST + b"\r\n")
    assert found.opened
    return server


def close_code(reply: bytes) -> int:
    """Return the code of a server's close frame."""
    assert reply[0] == 0x88
    return int.from_bytes(reply[2:4], "big")


def in_pieces(server: WsServer, data: bytes, sizes: list[int]) -> WsInput:
    """Feed data in chunks and join the results."""
    total = WsInput()
    at = 0
    while at < len(data):
        size = sizes.pop(0) if sizes else len(data)
        found = server.feed(data[at : at + size])
        at += size
        total.payload += found.payload
        total.reply += found.reply
        total.text_size += found.text_size
        total.opened |= found.opened
        total.ponged |= found.ponged
        total.ended = total.ended or found.ended
    return total


class TestHandshake:
    @pytest.mark.parametrize("step", [1, 7, 10_000])
    def test_request_of_the_standard_opens_the_connection(self, step: int) -> None:
        """The sample of RFC 6455 section 1.3."""
        found = in_pieces(WsServer(lambda origin: False), REQUEST + b"\r\n", [step] * 1000)
        assert found.opened
        assert found.reply.startswith(b"HTTP/1.1 101 ")
        assert b"s3pPLMBiTxaQ9kYGzzhZRbK+xOo=" in found.reply

    def test_page_of_a_refused_origin_gets_status_403(self) -> None:
        asked: list[str] = []
        server = WsServer(lambda origin: bool(asked.append(origin)))
        found = server.feed(REQUEST + b"Origin: https://example.org\r\n\r\n")
        assert asked == ["https://example.org"]
        assert found.reply.startswith(b"HTTP/1.1 403 ")
        assert b"origins=https://example.org" in found.reply
        assert not found.opened
        assert "example.org" in found.ended
        assert server.feed(masked(2, b"\xfd")) == WsInput()

    def test_request_with_two_origins_is_refused(self) -> None:
        server = WsServer(lambda origin: origin == "http://localhost")
        twice = b"Origin: http://localhost\r\nOrigin: https://example.org\r\n\r\n"
        assert server.feed(REQUEST + twice).ended

    @pytest.mark.parametrize(("offered", "agreed"), [(b"mqtt, binary", b"binary"), (b"mqtt", b"")])
    def test_only_a_known_protocol_is_accepted(self, offered: bytes, agreed: bytes) -> None:
        server = WsServer(lambda origin: False)
        reply = server.feed(REQUEST + b"Sec-WebSocket-Protocol: " + offered + b"\r\n\r\n").reply
        assert reply.startswith(b"HTTP/1.1 101 ")
        _, _, protocol = reply.partition(b"Sec-WebSocket-Protocol: ")
        assert protocol.partition(b"\r\n")[0] == agreed

    @pytest.mark.parametrize(
        ("data", "status"),
        [
            (b"GET / HTTP/1.1\r\nHost: x\r\n\r\n", b"400"),
            (b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: 0\r\n\r\n", b"400"),
            (REQUEST.replace(b": 13", b": 8") + b"\r\n", b"426"),
            (b"\xfd\x09\x00\x00\x00\x01\x01\x00\x00\x00\r\n\r\n", b"400"),
            (b"GET / HTTP/1.1\r\n" + b"X: " + b"y" * 100_000, b"400"),
            (REQUEST.replace(b"127.0.0.1:56781", b"xn--\xff") + b"\r\n", b"400"),
        ],
    )
    def test_invalid_upgrade_request_is_refused(self, data: bytes, status: bytes) -> None:
        found = WsServer(lambda origin: True).feed(data)
        assert found.ended
        assert found.reply.startswith(b"HTTP/1.1 " + status)


class TestMessages:
    FRAMES = (
        masked(2, b"one") + masked(2, b"t", fin=False) + masked(0, b"w", fin=False)
        + masked(9, b"there?") + masked(0, b"o") + masked(2, b"") + masked(2, bytes(300))
    )  # fmt: skip

    @pytest.mark.parametrize("seed", range(5))
    def test_fragments_are_joined_whatever_the_chunks(self, seed: int) -> None:
        chance = random.Random(seed)
        sizes = [chance.randint(1, 3 + 40 * seed) for _ in range(1000)]
        found = in_pieces(opened(), self.FRAMES, sizes)
        assert found.payload == b"onetwo" + bytes(300)
        assert found.reply == b"\x8a\x06there?"
        assert not found.ended

    def test_text_is_counted_and_is_not_payload(self) -> None:
        found = opened().feed(masked(1, "€".encode()) + masked(2, b"\xfd"))
        assert (found.text_size, found.payload, found.ended) == (3, b"\xfd", "")

    def test_last_of_several_pings_is_answered(self) -> None:
        """A peer that sends pings without end and never reads cannot fill our memory."""
        found = opened().feed(b"".join(masked(9, b"%d" % n) for n in range(1000)))
        assert found.reply == b"\x8a\x03999"

    @pytest.mark.parametrize(
        ("data", "code"),
        [
            (b"\x82\x03abc", CloseReason.PROTOCOL_ERROR),
            (masked(2, b"abc", rsv=4), CloseReason.PROTOCOL_ERROR),
            (masked(0, b"abc"), CloseReason.PROTOCOL_ERROR),
            (masked(3, b"abc"), CloseReason.PROTOCOL_ERROR),
            (masked(9, bytes(126)), CloseReason.PROTOCOL_ERROR),
            (masked(1, b"\xff\xff"), CloseReason.INVALID_FRAME_PAYLOAD_DATA),
            (masked(2, bytes(MAX_MESSAGE + 1)), CloseReason.MESSAGE_TOO_BIG),
            (
                masked(2, bytes(40_000), fin=False) + masked(0, bytes(40_000)),
                CloseReason.MESSAGE_TOO_BIG,
            ),
            (masked(1, bytes(MAX_MESSAGE + 1)), CloseReason.MESSAGE_TOO_BIG),
        ],
        ids=[
            "unmasked", "compressed", "continuation of nothing", "unknown", "long ping",
            "no UTF-8", "oversized", "oversized in fragments", "oversized text",
        ],
    )  # fmt: skip
    def test_invalid_frames_end_the_connection(self, data: bytes, code: CloseReason) -> None:
        server = opened()
        found = server.feed(data)
        assert close_code(found.reply) == code
        assert found.ended
        assert server.feed(masked(2, b"more")) == WsInput()

    def test_announced_huge_message_allocates_no_memory(self) -> None:
        """The bytes pass as they come; beyond the limit the connection ends."""
        server = opened()
        head = b"\x82\xff" + struct.pack("!Q", 1 << 62) + MASK
        assert server.feed(head).payload == b""
        passed = 0
        while not (found := server.feed(bytes(4096))).ended:
            passed += len(found.payload)
            assert passed <= MAX_MESSAGE
        assert close_code(found.reply) == CloseReason.MESSAGE_TOO_BIG

    def test_close_is_answered_with_a_close(self) -> None:
        found = opened().feed(masked(2, b"last") + masked(8, b"\x03\xe9going away"))
        assert found.payload == b"last"
        assert close_code(found.reply) == CloseReason.GOING_AWAY
        assert found.ended == "closed: 1001 going away"

    def test_compression_is_not_accepted(self) -> None:
        offer = b"Sec-WebSocket-Extensions: permessage-deflate\r\n\r\n"
        reply = WsServer(lambda origin: False).feed(REQUEST + offer).reply
        assert reply.startswith(b"HTTP/1.1 101 ")
        assert b"Extensions" not in reply

    @pytest.mark.parametrize("is_opened", [False, True])
    def test_garbage_never_raises(self, is_opened: bool) -> None:
        chance, good = random.Random(5), self.FRAMES if is_opened else REQUEST + b"\r\n"
        for _ in range(100):
            server = opened() if is_opened else WsServer(lambda origin: True)
            data = bytearray(good * 3)
            for _ in range(chance.randint(0, 8)):
                data[chance.randrange(len(data))] = chance.randrange(256)
            in_pieces(server, bytes(data), [chance.randint(1, 50) for _ in range(1000)])
