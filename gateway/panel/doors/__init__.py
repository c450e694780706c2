"""MAVLink as JSON, over HTTP and WebSocket, as mavlink2rest has it."""
