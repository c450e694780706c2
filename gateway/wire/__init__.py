"""Bytes of the receiver to raw records on the gateway clock; pure."""
