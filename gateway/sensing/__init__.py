"""Raw records to calibrated SI samples and their filters; pure."""
