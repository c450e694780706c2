"""State of the aircraft from MAVLink. Pure: time is an argument, without a browser."""
