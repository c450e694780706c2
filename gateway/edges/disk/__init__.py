"""Recordings, places and logs on the disk."""
