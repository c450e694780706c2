"""What the panel serves beside its page, and who may reach any of it."""
