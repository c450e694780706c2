"""Sources other than the receiver: convert the bytes of a tracker, radio or phone to records."""
