"""What the vehicle sends without being asked."""
