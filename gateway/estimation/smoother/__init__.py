"""A recorded flight smoothed from both ends."""
