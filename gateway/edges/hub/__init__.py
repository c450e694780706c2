"""The hub: MAVLink to and from every client, one file a transport."""
