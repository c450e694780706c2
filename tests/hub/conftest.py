"""Fixtures of the hub's tests."""

from tests.kit.hub import proven, rig

__all__ = ["proven", "rig"]
