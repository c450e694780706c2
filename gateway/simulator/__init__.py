"""A seeded flight with its sensors and its radio; pure."""
