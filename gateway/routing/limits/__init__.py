"""Limits: how much work each client may cause, and how much a narrow link is sent."""
