"""The settings as MAVLink parameters."""
