"""Instruments drawn in the browser: each a small Vue component and the Python that feeds it."""
