"""Answers of a vehicle that MAVLink contained before, given again.

`log_answers` collects them from a recording, `live_answers` from the frames that pass the hub;
`answer_cache` gives the latter to other stations of the same vehicle.
"""
