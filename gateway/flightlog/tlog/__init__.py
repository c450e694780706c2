"""The tlog format."""
