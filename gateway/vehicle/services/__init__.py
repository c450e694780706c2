"""The vehicle's MAVLink services, one per file."""
