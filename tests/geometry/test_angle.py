import math

import numpy as np
import pytest

from gateway.geometry.angle import wrap_180, wrap_pi


def test_angles_wrap_the_short_way_round() -> None:
    found = [wrap_180(a) for a in (180.0, -180.0, 359.0, -181.0, 541.0)]
    assert found == [-180, -180, -1, 179, -179]
    assert wrap_pi(math.radians(359.0)) == pytest.approx(math.radians(-1.0))


def test_arrays_wrap_as_their_items() -> None:
    turned_deg = np.array([-725.0, -180.0, 0.0, 180.0, 359.5])
    assert wrap_180(turned_deg).tolist() == [wrap_180(a) for a in turned_deg.tolist()]
    assert wrap_pi(turned_deg).tolist() == [wrap_pi(a) for a in turned_deg.tolist()]
