"""Tables in, numbers and pictures out."""
