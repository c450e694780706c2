"""What the person who runs the gateway sees and steers it by."""
