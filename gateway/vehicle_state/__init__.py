"""The state of vehicles as their MAVLink reports it: newest values, positions, senders, texts.

Everything here is computed from frames alone, so it serves live vehicles (outputs, panel,
recorder) and recorded ones (`gateway.recordings`) alike.
"""
