"""A seeded flight, its sensors and its radio; pure."""
