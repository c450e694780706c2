"""The panel: the aircraft's telemetry as a web page, served by a separate process."""
