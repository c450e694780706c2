"""Figures of a flight for reports, catalogue and lists: GPS outages and lost samples."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from gateway.recordings.recorded_clock import DAY_US
from gateway.units import US_PER_S

IntArray = NDArray[np.int64]
FloatArray = NDArray[np.float64]

OUTAGE_US: Final = US_PER_S
"""Minimum length of an outage: a longer gap between fixes is one."""
OUTAGE_STEPS: Final = 2.5
"""Minimum length of an outage in usual intervals, for receivers with a low rate."""
NODE_WRAP_US: Final = 1 << 32
"""Period after which a node's 32-bit clock wraps to zero."""
LONGEST_LOSS_US: Final = 60 * US_PER_S
"""Longest gap counted as lost samples; in a longer one the node was switched off."""


def gps_outages_us(
    gps_us: IntArray, fixed: NDArray[np.bool_], end_us: int
) -> list[tuple[int, int]] | None:
    """Return start and end of each outage from the first fix on; None if there is no fix at all.

    `gps_us`, shape (n,), are the times of all reports of the receiver; `fixed` marks reports with a
    fix.
    """
    fixes_us = gps_us[fixed]
    if not len(fixes_us):
        return None
    usual_us = float(np.median(np.diff(gps_us))) if len(gps_us) > 1 else 0.0
    ends_us = np.append(fixes_us[1:], max(end_us, int(fixes_us[-1])))
    gaps_us = ends_us - fixes_us
    # A gap of days is a jump of the clock, not an outage.
    is_outage = (gaps_us > max(OUTAGE_US, OUTAGE_STEPS * usual_us)) & (gaps_us <= DAY_US)
    begins, ends = fixes_us[is_outage].tolist(), ends_us[is_outage].tolist()
    return list(zip(begins, ends, strict=True))


def missing_samples(node_time_us: IntArray) -> FloatArray:
    """Count the samples missing before each sample except the first, by the node's own clock."""
    interval_us = np.diff(node_time_us) % NODE_WRAP_US
    usual_us = np.median(interval_us[interval_us > 0]) if interval_us.any() else 1.0
    missing = np.maximum(np.rint(interval_us / usual_us) - 1.0, 0.0)
    return np.where(interval_us > LONGEST_LOSS_US, 0.0, missing)


def lost_share(node_time_us: IntArray) -> float | None:
    """Return the proportion of missing samples; None for fewer than two samples."""
    if len(node_time_us) < 2:
        return None
    lost = float(missing_samples(node_time_us).sum())
    return lost / (lost + len(node_time_us))
