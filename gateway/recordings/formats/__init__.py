"""One file a format: its reader, its writer, or both."""
