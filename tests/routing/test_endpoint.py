"""Endpoint URLs: what they mean, and what is refused with which words."""

import msgspec
import pytest

from gateway.routing.endpoint import NO_MESSAGES, EndpointKind, parse_endpoint
from gateway.routing.hub_settings import HubSettings


@pytest.mark.parametrize(
    ("url", "kind", "host", "port"),
    [
        ("udp:127.0.0.1:14550", EndpointKind.UDP, "127.0.0.1", 14550),
        ("udp:[::1]:14550", EndpointKind.UDP, "::1", 14550),
        ("udp-listen:0.0.0.0:0", EndpointKind.UDP_LISTEN, "0.0.0.0", 0),
        ("udp-broadcast:192.168.1.255:14550", EndpointKind.UDP_BROADCAST, "192.168.1.255", 14550),
        ("udp-multicast:[ff02::1%lo]:14550", EndpointKind.UDP_MULTICAST, "ff02::1%lo", 14550),
        ("tcp:ground.example:5760", EndpointKind.TCP, "ground.example", 5760),
        ("tcp-listen:127.0.0.1:5760", EndpointKind.TCP_LISTEN, "127.0.0.1", 5760),
        ("serial:/dev/ttyUSB1:115200", EndpointKind.SERIAL, "/dev/ttyUSB1", 115200),
        ("serial:/dev/ttyUSB1", EndpointKind.SERIAL, "/dev/ttyUSB1", 57600),
    ],
)
def test_places(url: str, kind: EndpointKind, host: str, port: int) -> None:
    endpoint = parse_endpoint(url)
    assert (endpoint.kind, endpoint.host, endpoint.port) == (kind, host, port)
    assert endpoint.name == url


def test_options() -> None:
    endpoint = parse_endpoint(
        "udp:10.0.0.7:14550?name=tablet&deny=RAW_IMU,105&rate=attitude:5,VFR_HUD:0"
        "&pack=1100&trusted=no"
    )
    assert endpoint.name == "tablet"
    assert endpoint.deny == {27, 105}
    assert endpoint.interval_us == {30: 200_000, 74: NO_MESSAGES}
    assert endpoint.pack_bytes == 1100
    assert endpoint.trusted is False


def test_lists() -> None:
    allowing = parse_endpoint("udp:h:1?allow=HEARTBEAT,ATTITUDE&deny=ATTITUDE")
    assert [allowing.passes(message_id) for message_id in (0, 30, 33)] == [True, False, False]
    assert parse_endpoint("udp:h:1").passes(33)


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("carrier-pigeon:home:1", "carrier-pigeon"),
        ("udp:127.0.0.1", "HOST:PORT"),
        ("udp:::1:14550", "brackets"),
        ("udp:h:99999", "65535"),
        ("udp-listen:localhost:14550", "no address"),
        ("udp-multicast:group.example:14550", "no address"),
        ("serial:/dev/ttyUSB0:fast", "baud rate"),
        ("udp:h:1?colour=red", "colour"),
        ("udp:h:1?deny=NO_SUCH_MESSAGE", "NO_SUCH_MESSAGE"),
        ("udp:h:1?rate=ATTITUDE", "hertz"),
        ("udp:h:1?rate=ATTITUDE:-1", "Hz"),
        ("udp:h:1?rate=ATTITUDE:nan", "Hz"),
        ("udp:h:1?pack=1500", "1100"),
        ("udp:h:1?trusted=maybe", "yes or no"),
    ],
)
def test_refusals_name_the_endpoint_and_what_is_allowed(url: str, words: str) -> None:
    with pytest.raises(ValueError, match=r"endpoint .*" + words) as error:
        parse_endpoint(url)
    assert repr(url) in str(error.value)


def test_settings_refuse_an_endpoint_that_is_there_twice() -> None:
    with pytest.raises(ValueError, match="twice"):
        HubSettings(endpoints=("udp:h:1", "udp:h:1?name=same"))


def test_settings_refuse_a_wrong_endpoint_when_read() -> None:
    with pytest.raises(msgspec.ValidationError, match="carrier-pigeon"):
        msgspec.convert({"endpoints": ["carrier-pigeon:home:1"]}, HubSettings)
