"""Accuracy on recorded flights with a reference: limits for attitude, position and outages."""

from pathlib import Path

import pytest

from tools import score_estimators as scores
from tools.flights import read_flight
from tools.peers import run_vqf

LIMITS: dict[str, dict[str, float]] = {
    "arduplane_testlog2": {
        "roll": 0.85, "pitch": 0.72, "yaw": 1.4, "pos": 1.0, "out10": 4.5, "out30": 31.0,
    },
    "arducopter_quad106": {"total": 2.3, "pos": 0.75, "out10": 4.8},
    "car_rtk_drive0708_first_half": {"out10": 1.9, "out30": 8.5},
    "walk_rtk_0827": {"out10": 1.5},
    "px4_mocap_log008": {"total": 0.3},
    "phantom_rtk_dot2": {"inclination": 1.3, "pos": 0.2},
}  # fmt: skip
SHARE = 0.9
"""Least share of the time within two standard deviations."""
SHARES = {"arduplane_testlog2": {"alt_2s": 0.8}}
"""Its barometer and GPS, the reference of the height, differ by up to 16 m in manoeuvres."""


@pytest.mark.slow
@pytest.mark.parametrize("name", LIMITS)
def test_errors_are_within_limits(data_dir: Path, name: str) -> None:
    flight = read_flight(data_dir / f"{name}.csv.gz")
    out = scores.run_eskf(flight)
    found = scores.attitude_scores(flight, out[:, :4])
    limits = LIMITS[name]
    if "pos" in limits:
        found["pos"] = scores.rms(scores.position_errors_m(flight, out)[flight.counts])
    for key, length_s in (("out10", 10.0), ("out30", 30.0)):
        if key in limits:
            found[key] = scores.outage_score(flight, scores.run_eskf, length_s)
    assert {key: found[key] for key in limits if found[key] > limits[key]} == {}
    shares = scores.share_scores(flight, out)
    least = dict.fromkeys(shares, SHARE) | SHARES.get(name, {})
    assert {key: share for key, share in shares.items() if share < least[key]} == {}


@pytest.mark.slow
def test_magnetic_disturbances_are_handled_better_than_by_vqf(data_dir: Path) -> None:
    pytest.importorskip("vqf")
    names = ("broad_30_disturbed_stationary_magnet_C", "broad_33_disturbed_attached_magnet_2cm")
    for name in names:
        flight = read_flight(data_dir / f"{name}.csv.gz")
        own = scores.attitude_scores(flight, scores.run_eskf(flight)[:, :4])
        vqf = scores.attitude_scores(flight, run_vqf(flight))
        assert own["total"] < 1.25 * vqf["total"]
        assert own["inclination"] < 1.25 * vqf["inclination"]
