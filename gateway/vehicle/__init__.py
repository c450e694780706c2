"""Navigation states to MAVLink messages, and a client's requests to answers; pure."""
