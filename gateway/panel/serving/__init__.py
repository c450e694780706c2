"""Data that the panel serves besides its page, and access control."""
