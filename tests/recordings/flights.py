"""Flights fused live and recorded, for the tests of recordings."""

import math
from collections.abc import Mapping
from functools import cache

import msgspec
import numpy as np

from gateway.aircraft import AircraftSettings, SettingsChanged
from gateway.config import GatewaySettings
from gateway.estimation.select import EstimationSettings
from gateway.pipeline import Pipeline, PipelineSettings
from gateway.recordings.recorded_table import Line, ReadOptions, header_for
from gateway.recordings.rows import RowBuilder, TableRow
from gateway.recordings.table import TableHeader, TableNote, TableReader, encode_head, encode_line
from gateway.records import (
    BaroRaw,
    FusedSample,
    FusionState,
    GpsFix,
    ImuFlags,
    ImuRaw,
    NavState,
    NodeId,
    RawRecord,
)
from gateway.sensing.calibration import NodeCalibration
from gateway.vehicle.service import SettingsChange
from gateway.vehicle.vehicle_settings import VehicleSettings
from tests.kit.recordings import START_US
from tests.kit.records import fix_at, status

OPTIONS = ReadOptions(PipelineSettings(GatewaySettings().default_aircraft))
"""Files are read and fused with the default settings."""
IMU_US = 16_000
Changes = Mapping[int, SettingsChange]
"""By the number of the record after which they are made."""
NO_CHANGES: Changes = {}
CALIBRATION = NodeCalibration(
    accel_bias_mps2=(0.1, -0.2, 1 / 3), gyro_bias_radps=(0.01, 0.02, -0.03)
)


def make_settings(estimator: str) -> AircraftSettings:
    return AircraftSettings(
        estimation=msgspec.convert(
            {"estimator": estimator, "paper": {"accel_cutoff_hz": 7.3}}, EstimationSettings
        ),
        vehicle=VehicleSettings(signing_passphrase="secret"),
        calibration=CALIBRATION,
    )


def make_flight(rng: np.random.Generator, seconds: float) -> list[RawRecord]:
    """Fly a circle, with fixes and pressures that sometimes bunch up or come out of step."""
    records: list[RawRecord] = []
    node, count = NodeId(1, 0), int(seconds * 1e6 / IMU_US)
    for i in range(count):
        t = i * IMU_US + int(rng.integers(2000))
        if i % 6 == 0 or rng.random() < 0.02:
            records.append(BaroRaw(t, node, t, 100_000.0 - 0.1 * i + rng.normal(), 20.1))
        if i % 12 == 3 or rng.random() < 0.02:
            records.append(make_fix(t, rng))
        accel = (rng.normal(size=3) * 40 + (0, 600, 4096)).astype(int).tolist()
        gyro = (rng.normal(size=3) * 10 + (0, 0, 600)).astype(int).tolist()
        mag = (rng.normal(size=3) * 3 + (200, 30, -400)).astype(int).tolist()
        flags = ImuFlags.MAG_NEW if i % 4 == 0 else ImuFlags(0)
        records.append(
            ImuRaw(t, node, t, tuple(accel), tuple(gyro), tuple(mag), 500, 8, 500, 1090, flags)
        )
    return records


def make_fix(time_us: int, rng: np.random.Generator) -> GpsFix:
    angle = time_us * 1e-6 * 0.2
    return fix_at(
        time_us,
        node_time_us=time_us,
        itow_ms=time_us // 1000,
        lat_dege7=471_234_567 + round(9000 * math.sin(angle)),
        lon_dege7=85_678_901 + round(13_000 * math.cos(angle)),
        alt_amsl_m=430.123 + float(rng.normal()),
        vel_n_mps=(20 * math.cos(angle), -20 * math.sin(angle), 0.1),
        alt_ellipsoid_m=math.nan,
        utc_us=1_781_187_930_000_000 + time_us,
    )


def record(
    pipeline: Pipeline, records: list[RawRecord], changes: Changes = NO_CHANGES
) -> tuple[list[Line], list[NavState]]:
    """Fuse live; return the lines that the recorder writes, and the states."""
    rows = RowBuilder()
    lines: list[Line] = []
    states: list[NavState] = []
    for number, raw in enumerate(records):
        out = pipeline.feed_record(raw, raw.time_us)
        if number in changes:
            pipeline.aircraft[1].perform([changes[number]], raw.time_us, out)
        for action in out.records:
            if isinstance(action, SettingsChanged):
                lines += [*rows.flush(), header_for(pipeline.aircraft[1].settings, 1)]
            elif isinstance(action, FusedSample | BaroRaw | GpsFix):
                lines += rows.add(action)
            if isinstance(action, FusedSample):
                states.append(action.state)
    return lines, states


def fly(
    settings: AircraftSettings, records: list[RawRecord], changes: Changes = NO_CHANGES
) -> tuple[bytes, list[NavState]]:
    """Fuse live, and record as the recorder does."""
    lines, states = record(Pipeline(PipelineSettings(settings)), records, changes)
    head = encode_head(header_for(settings, 1))
    return (head + "".join(map(encode_line, lines))).encode(), states


@cache
def flown_table(seconds: float) -> bytes:
    """Return the table of a flight with the default settings."""
    rng = np.random.default_rng(20_240_611)
    return fly(GatewaySettings().default_aircraft, make_flight(rng, seconds))[0]


@cache
def commented_table() -> bytes:
    """Return a table with every kind of line among its rows and after the last."""
    settings = GatewaySettings().default_aircraft
    text = flown_table(12).decode()
    text = text.replace('"unix_us_at_zero":null', f'"unix_us_at_zero":{START_US}')
    lines = text.splitlines(keepends=True)
    lines[300:300] = map(encode_line, (TableNote(123, "over the wood"), header_for(settings, 1)))
    lines.insert(200, encode_line(status(supply_mv=3300, chips=("BMP280",))))
    lines.append(encode_line(TableNote(456, "landed")))
    return "".join(lines).encode()


def read(table: bytes) -> tuple[TableHeader, list[TableRow]]:
    reader = TableReader()
    rows = [row for row in reader.feed(table, final=True) if isinstance(row, TableRow)]
    assert reader.header is not None
    return reader.header, rows


def fly_from_the_middle(
    estimator: str, rng: np.random.Generator
) -> tuple[AircraftSettings, FusionState, list[TableRow]]:
    """Return a flight cut in the middle: the stored state there and all later rows."""
    settings = make_settings(estimator)
    pipeline, records = Pipeline(PipelineSettings(settings)), make_flight(rng, 30)
    half = len(records) // 2
    for raw in records[:half]:
        pipeline.feed_record(raw, raw.time_us)
    state = pipeline.aircraft[1].fusion_state
    rows = [line for line in record(pipeline, records[half:])[0] if isinstance(line, TableRow)]
    lines = [encode_head(header_for(settings, 1)), *map(encode_line, [state, *rows])]
    found, *again = TableReader().feed("".join(lines).encode(), final=True)
    assert isinstance(found, FusionState)
    assert repr(again) == repr(rows)
    return settings, found, rows
