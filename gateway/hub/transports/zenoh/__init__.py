"""The zenoh: endpoint: MAVLink of a site through a Zenoh router."""
