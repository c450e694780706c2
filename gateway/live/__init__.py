"""The running gateway: its composition root, serial port, control socket, metrics and console."""
