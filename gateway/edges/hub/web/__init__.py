"""MAVLink over WebSocket, for pages in a browser and for programs behind a web proxy."""
