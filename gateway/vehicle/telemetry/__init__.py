"""The vehicle's telemetry."""
