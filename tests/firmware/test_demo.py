"""`mavgate demo --firmware`: a ground station on the boards' own programs, in true time."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.end_to_end.processes import Client, Gateway
from tests.kit.process import START_LIMIT_S

pytestmark = [pytest.mark.io, pytest.mark.slow]


@pytest.fixture(params=["nrf24", "sx1276"])
def gateway(programs: Path, tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Gateway]:
    started = Gateway(tmp_path, "demo", "--firmware", request.param)
    yield started
    if started.process.poll() is None:
        started.process.kill()
        started.process.wait(START_LIMIT_S)


def test_ground_station_sees_the_vehicle(gateway: Gateway) -> None:
    client = Client(gateway.port)
    try:
        seen = client.until(lambda seen: {"ATTITUDE_QUATERNION", "GPS_RAW_INT"} <= set(seen))
    finally:
        client.sock.close()
    attitude = seen["ATTITUDE_QUATERNION"]
    assert attitude.get_srcSystem() == 1
    # It stands on the runway.
    assert abs(attitude.q2) < 0.1
    assert abs(attitude.q3) < 0.1
    assert gateway.end() == 0
    assert "Traceback" not in gateway.log.read_text()
