"""Exchanges with an aircraft of more than one message: parameters, files, calibrations."""
