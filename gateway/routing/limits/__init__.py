"""How much anybody may cause, and how much a narrow link is sent."""
