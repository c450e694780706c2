"""Firmware images: the settings in them, and writing them to a board with avrdude."""
