"""Endpoint URLs, the errors of malformed ones, and the pages that may connect."""

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.hub.endpoint import MAX_PORT, NO_MESSAGES, EndpointKind, admits_page, parse_endpoint
from gateway.hub.settings import HubSettings
from gateway.outputs import extend

extend()


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
        ("ws:[::1]:56781", EndpointKind.WS, "::1", 56781),
        ("ws-listen:127.0.0.1:56781", EndpointKind.WS_LISTEN, "127.0.0.1", 56781),
        ("wss:ground.example:443", EndpointKind.WSS, "ground.example", 443),
        ("wss-listen:0.0.0.0:443", EndpointKind.WSS_LISTEN, "0.0.0.0", 443),
        ("serial:/dev/ttyUSB1:115200", EndpointKind.SERIAL, "/dev/ttyUSB1", 115200),
        ("serial:/dev/ttyUSB1", EndpointKind.SERIAL, "/dev/ttyUSB1", 57600),
    ],
)
def test_kind_host_and_port_are_parsed(url: str, kind: EndpointKind, host: str, port: int) -> None:
    endpoint = parse_endpoint(url)
    assert (endpoint.kind, endpoint.host, endpoint.port) == (kind, host, port)
    assert endpoint.name == url


@pytest.mark.parametrize(
    ("written", "location"),
    [
        ("udpin:0.0.0.0:14550", "udp-listen:0.0.0.0:14550"),
        ("udpin://:14540", "udp-listen:0.0.0.0:14540"),
        ("udp-listen::14550", "udp-listen:0.0.0.0:14550"),
        ("udps:127.0.0.1:14550", "udp-listen:127.0.0.1:14550"),
        ("udpout:127.0.0.1:14550", "udp:127.0.0.1:14550"),
        ("udpout://127.0.0.1:14550", "udp:127.0.0.1:14550"),
        ("udpc:127.0.0.1:14550", "udp:127.0.0.1:14550"),
        ("127.0.0.1:14550", "udp:127.0.0.1:14550"),
        ("localhost:14550", "udp:localhost:14550"),
        ("ground.example:14550?name=x", "udp:ground.example:14550"),
        ("[::1]:14550", "udp:[::1]:14550"),
        ("udpbcast:127.255.255.255:14550", "udp-broadcast:127.255.255.255:14550"),
        ("mcast:239.255.145.50:14550", "udp-multicast:239.255.145.50:14550"),
        ("tcp://127.0.0.1:5760", "tcp:127.0.0.1:5760"),
        ("tcpout://127.0.0.1:5760", "tcp:127.0.0.1:5760"),
        ("tcpin:127.0.0.1:5760", "tcp-listen:127.0.0.1:5760"),
        ("tcpin://:5760", "tcp-listen:0.0.0.0:5760"),
        ("wsserver:127.0.0.1:56781", "ws-listen:127.0.0.1:56781"),
        ("ws://127.0.0.1:56781", "ws:127.0.0.1:56781"),
        ("serial:///dev/ttyUSB0:57600", "serial:/dev/ttyUSB0:57600"),
        ("/dev/ttyUSB0:57600", "serial:/dev/ttyUSB0:57600"),
        ("/dev/ttyUSB0,57600", "serial:/dev/ttyUSB0:57600"),
        ("/dev/ttyUSB0", "serial:/dev/ttyUSB0"),
    ],
)
def test_spellings_of_other_programs_are_understood(written: str, location: str) -> None:
    endpoint = parse_endpoint(written)
    assert endpoint.location == location
    assert parse_endpoint(location).kind is endpoint.kind


@pytest.mark.parametrize(
    ("written", "right"),
    [
        ("udp://127.0.0.1:14550", ["udp-listen:127.0.0.1:14550", "udp:127.0.0.1:14550"]),
        ("udp://127.0.0.1", ["udp-listen:127.0.0.1:PORT", "udp:127.0.0.1:PORT"]),
        ("udp://:14540", ["udp-listen:0.0.0.0:14540", "udp:HOST:14540"]),
        ("udp:0.0.0.0:14550", ["udp-listen:0.0.0.0:14550", "udp:HOST:14550"]),
        ("udp::14550", ["udp-listen:0.0.0.0:14550", "udp:HOST:14550"]),
        ("tcp:0.0.0.0:5760", ["tcp-listen:0.0.0.0:5760", "tcp:HOST:5760"]),
    ],
)
def test_ambiguous_spelling_is_refused_with_both_meanings(written: str, right: list[str]) -> None:
    with pytest.raises(ValueError, match="to wait for clients there") as error:
        parse_endpoint(written)
    assert all(spelling in str(error.value) for spelling in right)


def test_common_options_are_parsed() -> None:
    endpoint = parse_endpoint(
        "udp:10.0.0.7:14550?name=tablet&deny=RAW_IMU,105&rate=attitude:5,VFR_HUD:0"
        "&pack=1100&trusted=no"
    )
    assert endpoint.name == "tablet"
    assert endpoint.deny == {27, 105}
    assert endpoint.interval_us == {30: 200_000, 74: NO_MESSAGES}
    assert endpoint.pack_bytes == 1100
    assert endpoint.trusted is False


def test_websocket_options_are_parsed() -> None:
    listening = parse_endpoint("ws-listen:127.0.0.1:1?origins=https://Example.org:8443,null")
    assert listening.origins == {"https://example.org:8443", "null"}
    assert parse_endpoint("ws:127.0.0.1:1?path=/v1/raw").path == "/v1/raw"
    assert parse_endpoint("wss:127.0.0.1:1").path == "/"


def test_site_of_a_fleet_is_parsed() -> None:
    endpoint = parse_endpoint("zenoh:tcp/[::1]:7447?site=field-1&config=/etc/zenoh.json5&rate=30:5")
    assert (endpoint.host, endpoint.site, endpoint.keys) == ("tcp/[::1]:7447", "field-1", "site")
    assert endpoint.address == "tcp/[::1]:7447"
    assert endpoint.config == "/etc/zenoh.json5"
    assert endpoint.interval_us == {30: 200_000}
    assert parse_endpoint("zenoh:tls/h:7447?keys=mavlink_raw").keys == "mavlink_raw"
    sites = [parse_endpoint(f"zenoh:tcp/h:7447?site={site}&rate=30:5") for site in "ab"]
    assert {site.location for site in sites} == {
        "zenoh:tcp/h:7447?site=a",
        "zenoh:tcp/h:7447?site=b",
    }


def test_deny_applies_within_the_allowed_messages() -> None:
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
        ("udp-listen:localhost:14550", "not an address"),
        ("udp-multicast:group.example:14550", "not an address"),
        ("udp:127.0.0..1:14550", "neither an address nor a name"),
        ("udp:127.0.0.256:14550", "neither an address nor a name"),
        (f"udp:{'x' * 64}.example:14550", "neither an address nor a name"),
        ("udp:a b:14550", "neither an address nor a name"),
        ("udp:h:" + "9" * 5000, "65535"),
        ("serial:/dev/ttyUSB0:fast", "baud rate"),
        ("serial:/dev/ttyUSB0:9999999999", "baud rate"),
        ("serial:", "DEVICE"),
        ("serial:/dev/tty\n:57600", "cannot be printed"),
        ("udp:h:1?colour=red", "colour"),
        ("tcp-listen:127.0.0.1:1?origins=null", "origins"),
        ("ws-listen:127.0.0.1:1?origins=example.org", "https://example.org:8080"),
        ("ws-listen:127.0.0.1:1?origins=https://example.org/page", "https://example.org:8080"),
        ("ws-listen:localhost:1", "not an address"),
        ("ws:h:1?path=raw", "begin with /"),
        ("zenoh:tcp/h:7447", "site"),
        ("zenoh:tcp/h:7447?site=a/b", "a/b"),
        ("zenoh:tcp/h:7447?site=*", "letters"),
        ("zenoh:h:7447?site=a", "tcp/HOST"),
        ("zenoh:tcp/h:7447?site=a&keys=other", "mavlink_raw"),
        ("udp:h:1?site=a", "site"),
        ("ws:h:1?path=/a b", "spaces"),
        ("udp:h:1?deny=NO_SUCH_MESSAGE", "NO_SUCH_MESSAGE"),
        ("udp:h:1?rate=ATTITUDE", "hertz"),
        ("udp:h:1?rate=ATTITUDE:-1", "Hz"),
        ("udp:h:1?rate=ATTITUDE:nan", "Hz"),
        ("udp:h:1?rate=ATTITUDE:5e-324", "Hz"),
        ("udp:h:1?deny=99999999", "message id"),
        ("udp:h:1?pack=1500", "1100"),
        ("udp:h:1?trusted=no&trusted=yes", "'trusted' is given twice"),
        ("udp:h:1?name=x;trusted=no", "joined by &"),
        ("udp:h:1?name=%0a", "cannot be printed"),
        ("udp:h:1?trusted=maybe", "yes or no"),
        ("cot:tcp-listen:127.0.0.1:1", "has no carrier among"),
        ("cot:udp:h:1?callsign=", "callsign ''"),
        ("cot:udp:h:1?callsign=%1b", "callsign"),
        *((f"gdl90:udp:h:4000?callsign={name}", "callsign") for name in ("", "TOOLONG99", "low")),
        ("gdl90:udp:h:4000?callsign=A%26", "callsign"),
        ("mqtt:127.0.0.1:1883", "has no carrier among"),
        ("mqtt:tcp:h:1883?topic=a/%23", "topic"),
        ("mqtt:tcp:h:1883?topic=", "topic"),
        ("mqtt:tcp:h:1883?password=x", "option"),
        ("nmea:ws:127.0.0.1:1", "has no carrier among"),
        ("nmea:udp:127.0.0.1:0", "0 cannot be sent to"),
        ("nmea:tcp-listen:host:1", "not an address"),
        ("nmea:udp:h:1?rate=fast", "'fast' is not a number"),
        ("nmea:udp:h:1?rate=1000", "is not 0.01 to 50"),
        ("nmea:udp:h:1?rate=nan", "is not 0.01 to 50"),
        ("nmea:udp:h:1?vehicle=255", "vehicle 255 is not 1 to 249"),
        ("nmea:udp:h:1?callsign=x", "option"),
        ("rotator:serial:/dev/ttyS9:9600?station=here", "station 'here'"),
        *((f"rotator:serial:/dev/ttyS9:9600?station={wrong}", "station")
          for wrong in ("91,0,0", "1,2", "nan,2,3", "system:250")),
        ("rotator:serial:/dev/ttyS9:9600?protocol=spid", "protocol"),
    ],
)  # fmt: skip
def test_refusals_name_the_endpoint_and_what_is_allowed(url: str, words: str) -> None:
    with pytest.raises(ValueError, match=r"endpoint ") as error:
        parse_endpoint(url)
    assert words in str(error.value)
    assert repr(url) in str(error.value)


def test_outputs_of_two_vehicles_to_one_address_are_distinguished_by_name() -> None:
    urls = tuple(f"nmea:udp:h:1?vehicle={vehicle}&rate=2" for vehicle in (1, 2))
    assert HubSettings(endpoints=urls).endpoints == urls
    names = [f"nmea:udp:h:1?vehicle={vehicle}" for vehicle in (1, 2)]
    assert [parse_endpoint(url).name for url in urls] == names


@pytest.mark.parametrize(
    "urls",
    [("udp-listen:0.0.0.0:14550", "udpin://:14550"), ("udp:h:1", "udp:h:1?name=same")],
    ids=["two spellings", "other options"],
)
def test_settings_refuse_duplicate_endpoints(urls: tuple[str, ...]) -> None:
    with pytest.raises(ValueError, match="twice"):
        HubSettings(endpoints=urls)


def test_settings_refuse_a_malformed_endpoint() -> None:
    with pytest.raises(msgspec.ValidationError, match="carrier-pigeon"):
        msgspec.convert({"endpoints": ["carrier-pigeon:home:1"]}, HubSettings)


WORDS = st.sampled_from(
    [*EndpointKind, "udpin", "udpout", "tcpin", "mcast", "serial", "", "/dev/tty", "[::1]", "a.b"]
)
HOSTS = st.sampled_from(["://", ":", ":127.0.0.1:", ":[::1]:", ",", ":h:", "::"])
OPTIONS = st.lists(
    st.one_of(
        st.tuples(
            st.sampled_from(["name", "allow", "deny", "rate", "pack", "trusted", "x"]),
            st.one_of(
                st.text(max_size=12),
                st.integers().map(str),
                st.floats().map(lambda rate: f"ATTITUDE:{rate}"),
            ),
        ).map("=".join),
        st.text(max_size=8),
    ),
    max_size=4,
).map("&".join)
URLS = st.one_of(
    st.text(max_size=40),
    st.tuples(WORDS, HOSTS, st.one_of(st.integers().map(str), st.text(max_size=8)), OPTIONS).map(
        lambda parts: f"{parts[0]}{parts[1]}{parts[2]}?{parts[3]}"
    ),
)


@given(URLS)
def test_any_text_is_a_usable_endpoint_or_is_refused_by_name(url: str) -> None:
    try:
        endpoint = parse_endpoint(url)
    except ValueError as error:
        assert repr(url) in str(error)  # noqa: PT017
        return
    assert endpoint.name.isprintable()
    assert endpoint.host
    endpoint.host.encode("idna")
    if endpoint.kind is not EndpointKind.SERIAL:
        assert 0 <= endpoint.port <= MAX_PORT
    assert all(us == NO_MESSAGES or 0 < us < 1 << 40 for us in endpoint.interval_us.values())
    again = parse_endpoint(endpoint.location)
    assert (again.kind, again.host, again.port) == (endpoint.kind, endpoint.host, endpoint.port)


def test_client_name_begins_with_the_name_of_its_port() -> None:
    named = parse_endpoint("udp-listen:0.0.0.0:14551?name=tablets")
    assert named.name_of("10.0.0.7:3000") == "tablets 10.0.0.7:3000"
    assert parse_endpoint("udp-listen:0.0.0.0:14551").name_of("10.0.0.7:3000") == "10.0.0.7:3000"


@pytest.mark.parametrize(
    "origin",
    [
        "http://localhost",
        "https://LOCALHOST:8443",
        "http://panel.localhost:80",
        "http://127.0.0.1:8080",
        "http://127.8.9.1",
        "http://[::1]:8080",
        "http://[::ffff:127.0.0.1]",
        "http://192.168.4.1:8000",
    ],
)
def test_page_of_this_machine_is_admitted(origin: str) -> None:
    assert admits_page(origin, "192.168.4.1", ())


@pytest.mark.parametrize(
    "origin",
    [
        "https://example.org",
        "http://localhost.example.org",
        "http://notlocalhost",
        "http://127.0.0.1.example.org",
        "http://192.168.4.2",
        "null",
        "",
        "file://",
        "chrome-extension://127.0.0.1",
        "http://[::1",
        "http://127.0.0.1,http://example.org",
        "http://user@example.org#127.0.0.1",
    ],
)
def test_page_of_another_machine_is_admitted_only_if_named(origin: str) -> None:
    assert not admits_page(origin, "192.168.4.1", ())
    assert admits_page(origin.upper(), "192.168.4.1", {origin})


def test_mapped_address_is_the_same_machine() -> None:
    assert admits_page("http://192.168.4.1", "::ffff:192.168.4.1", ())
