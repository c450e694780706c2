"""URLs of outputs."""

import pytest

from gateway.hub.endpoint import parse_endpoint
from gateway.hub.settings import HubSettings
from gateway.outputs import extend


@pytest.mark.parametrize(
    ("url", "reason"),
    [
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
def test_wrong_urls_are_refused_with_the_reason(url: str, reason: str) -> None:
    extend()
    with pytest.raises(ValueError, match=reason):
        parse_endpoint(url)


def test_outputs_of_two_vehicles_to_one_address_are_distinguished_by_name() -> None:
    extend()
    urls = tuple(f"nmea:udp:h:1?vehicle={vehicle}&rate=2" for vehicle in (1, 2))
    assert HubSettings(endpoints=urls).endpoints == urls
    names = [f"nmea:udp:h:1?vehicle={vehicle}" for vehicle in (1, 2)]
    assert [parse_endpoint(url).name for url in urls] == names
