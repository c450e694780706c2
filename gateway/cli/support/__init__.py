"""Parts shared by the commands."""
