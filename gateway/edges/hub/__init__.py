"""The hub: MAVLink to and from every client, one file per transport."""
