"""Thousands of recordings: a catalogue of them, and work on all of them at once."""
