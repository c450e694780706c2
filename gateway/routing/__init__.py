"""Who gets which MAVLink frame: endpoints, clients, filters, rates, queues; no I/O."""
