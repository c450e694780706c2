"""Commands for a gateway that runs."""
