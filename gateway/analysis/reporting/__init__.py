"""The report of a flight as one page."""
