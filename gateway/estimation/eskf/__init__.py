"""The error-state Kalman filter, which fuses all sensors."""
