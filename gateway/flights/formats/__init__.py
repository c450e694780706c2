"""File formats of other programs, read by packages that are extras."""
