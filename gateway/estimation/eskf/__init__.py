"""The error-state Kalman filter: the one estimator that fuses every sensor."""
