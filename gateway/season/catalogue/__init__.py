"""The catalogue of the recordings under a folder."""
