"""Recordings as streams: opened from any format, and fused again."""
