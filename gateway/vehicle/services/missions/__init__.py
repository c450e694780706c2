"""Missions, fences, rally points, home and the marked location."""
