"""Settings in firmware images, and writing images to a board with avrdude."""
