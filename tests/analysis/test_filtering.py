import numpy as np
import pytest
from scipy import signal

from gateway.analysis.signals import apply, compare, response
from gateway.estimation.paper.paper import PaperSettings

SETTINGS = PaperSettings()


@pytest.mark.parametrize("rate_hz", [100.0, 1000.0])
def test_butterworth_is_3_db_down_at_the_cutoff_and_flat_below(rate_hz: float) -> None:
    table = compare(SETTINGS, rate_hz).set_index("filter")
    assert table.loc["butterworth", "gain at cutoff, dB"] == pytest.approx(-3.01, abs=0.02)
    assert table.loc["butterworth", "ripple, dB"] == pytest.approx(0.0, abs=1e-6)
    assert table.loc["chebyshev", "ripple, dB"] == pytest.approx(1.0, abs=0.01)
    assert table.loc["butterworth", "step overshoot, %"] < 6.0
    assert table.loc["chebyshev", "step overshoot, %"] > 12.0
    assert (table["time a sample, ns"] > 0.0).all()


def test_phase_and_delay_belong_together() -> None:
    found = response("butterworth", SETTINGS, 1000.0)
    slope = -np.gradient(np.radians(found.phase_deg), 2.0 * np.pi * found.frequency_hz)
    middle = slice(20, -20)
    assert found.delay_ms[middle] == pytest.approx(1e3 * slope[middle], rel=0.02)
    assert found.gain_db[0] == pytest.approx(0.0, abs=1e-6)


def test_the_filter_is_the_gateways_own(rng: np.random.Generator) -> None:
    x = rng.normal(size=(300, 3))
    b, a = signal.butter(2, 10.0, fs=100.0)
    expected = signal.lfilter(b, a, x - x[0], axis=0) + x[0]
    assert apply("butterworth", SETTINGS, 100.0, x) == pytest.approx(expected)
