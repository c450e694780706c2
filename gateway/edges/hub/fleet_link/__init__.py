"""MAVLink through a Zenoh router: what a site and its fleet have in common."""
