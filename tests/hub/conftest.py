"""Fixtures of the hub's tests."""

from tests.kit.hub import rig

__all__ = ["rig"]
