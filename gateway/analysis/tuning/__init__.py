"""Settings tried out on flights."""
