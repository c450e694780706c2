"""One work on many recordings, in processes here or on other machines."""
