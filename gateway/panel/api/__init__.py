"""MAVLink as JSON, over HTTP and WebSocket, as in mavlink2rest."""
