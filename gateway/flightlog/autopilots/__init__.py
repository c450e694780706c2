"""Autopilots' own logs as records: what their fields mean, in our units and frames."""
