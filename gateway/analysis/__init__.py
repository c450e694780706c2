"""Analyse flights: from tables to figures and plots."""
