"""Clocks, ports, sockets and files: the only I/O."""
