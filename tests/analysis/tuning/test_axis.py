import pytest

from gateway.analysis.sweep import (
    Axis,
    SweepError,
    full_key,
    grid,
    parse_axis,
    with_value,
)
from gateway.recordings.fuse import FusionSettings

ALPHA, BETA = "estimation.paper.alpha_accel", "estimation.paper.beta_velocity"
LATENCY = "estimation.reference.gps_latency_s"


@pytest.mark.parametrize(
    ("name", "key"),
    [
        ("alpha", ALPHA),
        ("beta", BETA),
        ("gps_latency_s", LATENCY),
        ("accel_cutoff_hz", "estimation.paper.accel_cutoff_hz"),
        ("reference.declination_deg", "estimation.reference.declination_deg"),
    ],
)
def test_a_setting_is_found_by_its_name(name: str, key: str) -> None:
    assert full_key(name) == key


def test_an_unknown_setting_is_reported() -> None:
    with pytest.raises(SweepError, match="no setting ends in 'gama'"):
        full_key("gama")


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("0.1:0.9:9", (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)),
        ("0.5,0.1", (0.5, 0.1)),
        ("0:1", (0.0, 1.0)),
        ("0.25", (0.25,)),
    ],
)
def test_values_are_read(text: str, values: tuple[float, ...]) -> None:
    assert parse_axis("alpha", text).values == values


def test_names_are_values_too() -> None:
    axis = parse_axis("accel_filter", "butterworth, chebyshev")
    assert axis == Axis("estimation.paper.accel_filter", ("butterworth", "chebyshev"))


@pytest.mark.parametrize("text", ["0:2:3", "a:b:c", "-0.1", "chebyshev"])
def test_values_that_are_not_allowed_are_reported(text: str) -> None:
    with pytest.raises(SweepError, match="alpha"):
        parse_axis("alpha", text)


def test_a_value_lands_where_it_belongs() -> None:
    changed = with_value(FusionSettings(), ALPHA, 0.7)
    assert changed.estimation.paper.alpha_accel == 0.7
    assert changed.estimation.paper.beta_velocity == 0.1
    assert changed.estimation.eskf == FusionSettings().estimation.eskf


def test_a_grid_is_every_point() -> None:
    axes = [Axis("a", (1, 2)), Axis("b", (3, 4, 5))]
    assert grid(axes) == [(1, 3), (1, 4), (1, 5), (2, 3), (2, 4), (2, 5)]


def test_a_grid_too_large_is_refused() -> None:
    with pytest.raises(SweepError, match="1000000 points"):
        grid([Axis("a", tuple(range(1000))), Axis("b", tuple(range(1000)))])
