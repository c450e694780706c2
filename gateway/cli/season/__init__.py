"""What the commands over many recordings share."""
