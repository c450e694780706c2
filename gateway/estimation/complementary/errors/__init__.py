"""Errors of attitude and sensors: a Kalman filter, and what tells it of them."""
