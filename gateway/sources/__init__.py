"""Sources other than the receiver: bytes of any tracker, radio or phone in, records out."""
