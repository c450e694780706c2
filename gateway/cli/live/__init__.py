"""Commands for a running gateway."""
