"""Fixtures of the hub's tests."""

from tests.kit.hub import loop_errors, rig

__all__ = ["loop_errors", "rig"]
