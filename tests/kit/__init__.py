"""Shared by tests of every package: MAVLink frames, ports, and the command line."""
