"""Figures for pilots, of flights whose figures are known."""

import numpy as np
import pytest

from gateway.analysis.flight import FlightTrack, LocalFrame, local_frame
from gateway.analysis.pilot_figures import pilot_figures
from tests.analysis.flights import short_case, short_flight, with_imu

RATE_HZ = 50


def test_the_simulated_flight() -> None:
    case = short_case()
    assert case.frame is not None
    figures = pilot_figures(case.flight, case.track, case.frame)
    truth = case.flight.reference
    assert truth is not None
    speed = np.hypot(truth.track.vel_n_mps[:, 0], truth.track.vel_n_mps[:, 1])
    assert figures.fastest_mps == pytest.approx(float(speed.max()), abs=1.0)
    height = truth.track.alt_amsl_m - truth.track.alt_amsl_m[0]
    assert figures.highest_m == pytest.approx(float(height.max()), abs=8.0)
    flown = speed[:-1] * np.diff(case.flight.time_s)
    assert figures.distance_m == pytest.approx(float(flown[height[1:] > 3.0].sum()), rel=0.05)
    assert [round(end - begin) for begin, end in figures.gps_outages_s] == [3]
    assert figures.link_losses_s == ()
    texts = [event.text for event in figures.events]
    assert texts[0] == "in the air"
    assert any(text.startswith("GPS lost for 3") for text in texts)
    assert [e.time_s for e in figures.events] == sorted(e.time_s for e in figures.events)


def made(north_m: np.ndarray, height_m: np.ndarray, speed_mps: np.ndarray) -> tuple:
    """Lay a motion along the meridian over the samples of the short flight."""
    flight = short_flight()
    frame = local_frame(flight)
    assert frame is not None
    lat = frame.lat_deg + north_m / frame.north_m(np.array([frame.lat_deg + 1.0]))[0]
    velocity = np.column_stack([speed_mps, np.zeros_like(speed_mps), np.zeros_like(speed_mps)])
    count = len(flight.time_us)
    track = FlightTrack(
        flight.time_us, np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)), lat,
        np.full(count, frame.lon_deg), frame.alt_m + height_m, velocity,
    )  # fmt: skip
    return flight, track, frame


def test_distance_is_flown_in_the_air_and_not_jumped() -> None:
    seconds = short_flight().time_s
    up = (seconds > 10.0) & (seconds < 30.0)
    north = np.where(seconds > 10.0, np.minimum(seconds - 10.0, 20.0) * 5.0, 0.0)
    north = north + np.where(seconds > 20.0, 1000.0, 0.0)
    flight, track, frame = made(north, np.where(up, 20.0, 0.0), np.where(up, 5.0, 0.0))
    figures = pilot_figures(flight, track, frame)
    assert figures.airborne_s == pytest.approx(20.0, abs=0.2)
    assert figures.distance_m == pytest.approx(100.0, abs=1.0)
    assert figures.farthest_m == pytest.approx(1100.0, abs=1.0)


def test_a_hop_of_a_second_is_no_flight() -> None:
    seconds = short_flight().time_s
    up = (seconds > 10.0) & (seconds < 11.0)
    flight, track, frame = made(0.0 * seconds, np.where(up, 9.0, 0.0), np.where(up, 9.0, 0.0))
    assert pilot_figures(flight, track, frame).airborne_s == 0.0


def test_gap_in_the_samples_is_a_loss_of_the_link() -> None:
    flight = short_flight()
    late = flight.time_us + np.where(flight.time_s > 20.0, 4_000_000, 0)
    case = short_case()
    assert case.frame is not None
    figures = pilot_figures(with_imu(flight, time_us=late), case.track, case.frame)
    ((begin, end),) = figures.link_losses_s
    assert end - begin == pytest.approx(4.0 + 1.0 / RATE_HZ, abs=0.05)


def test_unknown_figures_are_nan() -> None:
    flight = short_flight()
    count = len(flight.time_us)
    unknown = np.full(count, np.nan)
    track = FlightTrack(
        flight.time_us, np.full((count, 4), np.nan), unknown, unknown, unknown,
        np.full((count, 3), np.nan),
    )  # fmt: skip
    figures = pilot_figures(flight, track, LocalFrame(47.0, 8.0, 400.0))
    assert np.isnan([figures.highest_m, figures.fastest_mps, figures.farthest_m]).all()
    assert (figures.distance_m, figures.airborne_s) == (0.0, 0.0)
