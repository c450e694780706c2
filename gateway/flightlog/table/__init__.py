"""Flights as tables: our CSV, and other formats read into the same rows."""
