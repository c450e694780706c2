"""Transports: one file per kind of endpoint."""
