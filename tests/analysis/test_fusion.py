from collections import deque

import msgspec
import numpy as np
import pytest

from gateway.analysis.case import ESTIMATORS, with_estimator
from gateway.analysis.flight import FlightTrack, fuse_track
from gateway.analysis.metrics import position_error_m, rms
from gateway.estimation.select import make_estimator
from gateway.records import BaroSample, NavFlags
from tests.analysis.flights import short_case, short_flight


@pytest.mark.parametrize("name", ESTIMATORS)
def test_a_whole_flight_at_once_equals_sample_by_sample(name: str) -> None:
    flight, case = short_flight(), short_case()
    estimator = make_estimator(with_estimator(case.fusion, name).estimation)
    waiting = deque(flight.samples.aiding)
    for k, sample in enumerate(flight.samples.imu.samples()[:1500]):
        while waiting and waiting[0][0] <= k:
            _, record = waiting.popleft()
            if isinstance(record, BaroSample):
                estimator.update_baro(record)
            else:
                estimator.update_gps(record)
        state = estimator.update_imu(sample)
        if k % 300 == 299:
            track, valid = case.tracks[name], NavFlags.POSITION_VALID in state.flags
            assert state.q_nb == tuple(track.q_nb[k])
            assert np.isfinite(track.lat_deg[k]) == valid
            if valid:
                assert (state.lat_deg, state.lon_deg) == (track.lat_deg[k], track.lon_deg[k])
                assert state.vel_n_mps == tuple(track.vel_n_mps[k])


@pytest.mark.parametrize("name", ESTIMATORS)
def test_the_fused_track_is_near_the_truth(name: str) -> None:
    flight = short_flight()
    assert flight.reference is not None
    error = position_error_m(short_case().tracks[name], flight.reference.track)[flight.scored]
    assert rms(np.hypot(error[:, 0], error[:, 1])) < 4.0


def test_values_without_a_validity_flag_are_unknown() -> None:
    track: FlightTrack = short_case().tracks["paper"]
    first_s = short_flight().seconds(
        np.array([f.time_us for f in short_flight().fixes if f.fix_ok])
    )
    unknown = short_flight().time_s < first_s[0]
    assert np.isnan(track.lat_deg[unknown]).all()
    assert np.isfinite(track.lat_deg[~unknown]).all()


def test_another_cutoff_gives_another_track() -> None:
    flight, fusion = short_flight(), with_estimator(short_case().fusion, "paper")
    paper = msgspec.structs.replace(fusion.estimation.paper, accel_cutoff_hz=2.0)
    estimation = msgspec.structs.replace(fusion.estimation, paper=paper)
    changed = fuse_track(flight, msgspec.structs.replace(fusion, estimation=estimation))
    assert not np.array_equal(changed.q_nb, short_case().tracks["paper"].q_nb)
