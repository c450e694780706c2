import numpy as np

from gateway.panel.state.fields import fields_csv


def test_fields_that_came_at_other_times_share_a_table() -> None:
    series = {
        "A.x": (np.array([0, 500_000]), np.array([1.0, np.nan])),
        "B.y": (np.array([250_000]), np.array([-0.125])),
    }
    assert fields_csv(series, {"A.x": "m/s"}, 1_700_000_000_000_000).splitlines() == [
        "time_unix_s,A.x (m/s),B.y",
        "1700000000.000000,1,",
        "1700000000.250000,,-0.125",
        "1700000000.500000,,",
    ]


def test_nothing_chosen_is_an_empty_table() -> None:
    assert fields_csv({}, {}, 0) == "time_unix_s\n"
