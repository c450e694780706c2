"""Thousands of recordings: an index, and tasks on all of them, local or on other machines."""
