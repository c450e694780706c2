"""Thousands of recordings: an index of them, and one task on all, here or on other machines."""
