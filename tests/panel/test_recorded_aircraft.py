"""Aircraft of a recording, as found before it is played."""

from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace
from pymavlink.dialects.v20 import all as mavlink

from gateway.config import GatewaySettings
from gateway.panel.playback import FUSED_AGAIN, RECORDED, free_ids, recorded_aircraft
from gateway.recordings.rows import row_to_line
from gateway.recordings.table import encode_head
from gateway.units import US_PER_S
from tests.kit.messages import at, beat
from tests.kit.recordings import records_sent, write_tlog
from tests.recordings.flights import fly, make_flight, read

pytestmark = pytest.mark.io


def test_heights_of_each_aircraft_in_a_tlog_are_read(tmp_path: Path) -> None:
    sent = [((42, 190), beat(mavlink.MAV_TYPE_GCS))]
    for n in range(5):
        sent += [((1, 1), at(alt_m=100 + n)), ((7, 1), at(alt_m=300))]
    tlog = write_tlog(tmp_path / "two_01.tlog", records_sent(sent, US_PER_S // 2))
    ((first, second),) = recorded_aircraft([tlog])
    assert (first.recorded_id, second.recorded_id) == (1, 7)
    assert {first.origin, second.origin} == {RECORDED}
    assert first.profile.time_s == (0.5, 1.5, 2.5, 3.5, 4.5)
    assert first.profile.alt_amsl_m == (100.0, 101.0, 102.0, 103.0, 104.0)
    assert second.profile.alt_amsl_m == (300.0,) * 5


def test_heights_of_a_table_are_of_its_states(tmp_path: Path, rng: np.random.Generator) -> None:
    header, rows = read(fly(GatewaySettings().default_aircraft, make_flight(rng, 10))[0])
    header = replace(header, vehicle_id=7)
    table = tmp_path / "a_01_v1.csv"
    table.write_text(encode_head(header) + "".join(map(row_to_line, rows)))
    ((found,),) = recorded_aircraft([table])
    assert (found.recorded_id, found.origin) == (7, FUSED_AGAIN)
    assert found.profile.time_s[-1] == pytest.approx(10.0, abs=0.5)
    heights = [row.state.alt_amsl_m for row in rows if row.state is not None]
    assert set(found.profile.alt_amsl_m) <= set(heights)
    assert 40 < len(found.profile.alt_amsl_m) <= 51, "5 Hz, both ends included"


def test_played_aircraft_get_unused_ids() -> None:
    assert free_ids(2, {1, 2}) == range(248, 250)
    assert free_ids(2, {1, 249, 247}) == range(245, 247)
    with pytest.raises(ValueError, match="3 more aircraft"):
        free_ids(3, range(2, 250, 2))
