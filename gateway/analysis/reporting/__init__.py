"""The report of a flight as a page."""
