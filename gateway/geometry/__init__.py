"""Rotations and geodesy shared by the stages."""
