"""Short simulated recordings that differ in aircraft, day and noise, made in no time."""

from functools import cache
from itertools import count
from pathlib import Path

import msgspec
import numpy as np
from msgspec.structs import replace

from gateway.aircraft import AircraftSettings
from gateway.recordings.recorded_table import header_for
from gateway.recordings.rows import TableRow, row_to_line
from gateway.recordings.table import encode_head
from gateway.records import BaroRaw, GpsFix, ImuRaw, NodeId
from gateway.sensing.calibration import NodeCalibration
from gateway.simulator.simulator_settings import SimulatorSettings
from tools.simulated_flight import SimulatedFlight, fly

OUTAGE_S = (28.0, 3.0)
DURATION_S = 40.0
DAY_0_US = 1_780_000_000_000_000
DAY_US = 86_400_000_000


@cache
def simulated() -> SimulatedFlight:
    settings = SimulatorSettings(imu_rate_hz=50, baro_rate_hz=5, gps_outages_s=(OUTAGE_S,))
    return fly(settings, duration_s=DURATION_S)


@cache
def _records() -> tuple[ImuRaw | BaroRaw | GpsFix, ...]:
    return tuple(r for r in simulated().records() if isinstance(r, ImuRaw | BaroRaw | GpsFix))


def line_of(record: ImuRaw | BaroRaw | GpsFix) -> str:
    kind = {ImuRaw: "raw", BaroRaw: "baro", GpsFix: "gps"}[type(record)]
    return row_to_line(TableRow(record.time_us, **{kind: record}))


def write_flight(
    path: Path, *, vehicle: int = 1, day: int = 0, noise_m: float = 0.0, lost: int = 0
) -> Path:
    """Write the flight as a recording.

    `noise_m` is added to every fix, seeded by aircraft and day; every `lost`-th IMU sample is lost.
    """
    rng = np.random.default_rng([vehicle, day])
    aircraft = AircraftSettings(calibration=NodeCalibration(**simulated().errors))
    header = msgspec.structs.replace(
        header_for(aircraft, vehicle), unix_us_at_zero=DAY_0_US + day * DAY_US
    )
    lines, imu = [encode_head(header)], count(1)
    for record in _records():
        record = replace(record, node=NodeId(vehicle, record.node.node_id))
        if isinstance(record, ImuRaw) and lost and next(imu) % lost == 0:
            continue
        if isinstance(record, GpsFix):
            north, east = (rng.normal(0.0, noise_m, 2) / 0.0111).astype(int).tolist()
            lat, lon = record.lat_dege7 + north, record.lon_dege7 + east
            record = replace(record, lat_dege7=lat, lon_dege7=lon)
        lines.append(line_of(record))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(lines))
    return path
