"""mavgate: a MAVLink telemetry gateway for home-made UAV trackers."""

__version__ = "0.1.0"
