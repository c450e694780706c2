"""Recordings, places and logs on disk."""
