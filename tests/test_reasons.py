"""Texts of faulty states."""

import pytest

from gateway.reasons import receiver_state


@pytest.mark.parametrize(
    ("connected", "received", "frames", "text"),
    [
        (False, 0, 0, "not connected"),
        (True, 0, 0, "connected, silent"),
        (True, 5000, 90, "connected"),
        (True, 5000, 0, "serial.baud"),
    ],
)
def test_port_without_frames_is_described(
    connected: bool, received: int, frames: int, text: str
) -> None:
    state = receiver_state(connected, received, frames)
    assert text in state
    assert (state == "connected") == (frames > 0)
