"""What the vehicle answers: one service a file."""
