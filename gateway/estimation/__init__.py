"""Calibrated samples to navigation states; pure."""
