import numpy as np
import pytest
from scipy import signal

from gateway.analysis.signals import filtered
from gateway.estimation.vector_filter import (
    PASS_THROUGH,
    Coefficients,
    Kind,
    design_highpass,
    discretise,
    prototype_of,
)


def design_lowpass(
    kind: Kind, cutoff_hz: float, rate_hz: float, ripple_db: float = 1.0
) -> Coefficients:
    return discretise(*prototype_of(kind, ripple_db), cutoff_hz, rate_hz)


def test_cutoff_beyond_half_the_sample_rate_passes_all() -> None:
    assert design_lowpass("butterworth", 10.0, 20.0) == PASS_THROUGH
    assert design_highpass(0.0, 20.0) == PASS_THROUGH


@pytest.mark.parametrize("kind", ["butterworth", "chebyshev"])
def test_pieces_give_the_bits_of_the_whole(kind: str) -> None:
    x = np.random.default_rng(3).normal(size=(500, 3))
    c, state = design_lowpass(kind, 10.0, 200.0), [np.nan] * 6
    pieces = [filtered(c, piece, state) for piece in (x[:0], x[:1], x[1:123], x[123:])]
    np.testing.assert_array_equal(np.vstack(pieces), filtered(c, x))


def test_lowpass_output_equals_scipy() -> None:
    x = np.random.default_rng(4).normal(size=(300, 3)) + 5.0
    b, a = signal.butter(2, 10.0, fs=100.0)
    zi = signal.lfilter_zi(b, a)[:, None] * x[0]
    expected, _ = signal.lfilter(b, a, x, axis=0, zi=zi)
    got = filtered(design_lowpass("butterworth", 10.0, 100.0), x)
    np.testing.assert_allclose(got, expected, atol=1e-12)


@pytest.mark.parametrize("kind", ["butterworth", "chebyshev"])
@pytest.mark.parametrize("rate_hz", [60.0, 200.0, 1000.0])
def test_no_transient_at_start(kind: str, rate_hz: float) -> None:
    still = np.tile((0.3, -0.2, -9.81), (50, 1))
    np.testing.assert_allclose(filtered(design_lowpass(kind, 10.0, rate_hz), still), still)


def test_highpass_removes_a_constant_at_once() -> None:
    first, second = filtered(
        design_highpass(0.01, 100.0), np.array([(0.5, 0.5, 0.5), (1.5, 0.5, 0.5)])
    )
    assert first == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)
    assert second[0] == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("kind", ["butterworth", "chebyshev"])
@pytest.mark.parametrize("rate_hz", [50.0, 100.0, 1000.0])
@pytest.mark.parametrize("share", [1e-4, 0.01, 0.1, 0.3, 0.49])
def test_designs_are_those_of_scipy(kind: str, rate_hz: float, share: float) -> None:
    cutoff_hz = share * rate_hz
    if kind == "butterworth":
        b, a = signal.butter(2, cutoff_hz, fs=rate_hz)
    else:
        b, a = signal.cheby1(2, 0.7, cutoff_hz, fs=rate_hz)
        b = b * (a.sum() / b.sum())
    found = design_lowpass(kind, cutoff_hz, rate_hz, 0.7)
    np.testing.assert_allclose(found, (*b, *a[1:]), rtol=1e-7)
    b, a = signal.butter(1, cutoff_hz, "highpass", fs=rate_hz)
    np.testing.assert_allclose(design_highpass(cutoff_hz, rate_hz), (*b, 0.0, a[1], 0.0), rtol=1e-9)
