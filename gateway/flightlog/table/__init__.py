"""Flights as tables: our CSV, and what is read into the same rows."""
