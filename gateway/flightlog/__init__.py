"""Recording formats and playback state machines; pure."""
