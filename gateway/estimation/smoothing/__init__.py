"""Recordings smoothed from both ends."""
