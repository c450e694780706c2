"""The receiver's serial port, real and simulated."""
