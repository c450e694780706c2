"""What came over MAVLink, by aircraft. Pure: time is an argument, nothing here knows a browser."""
