"""Recordings: their formats, and the operations on them.

A flight of any format is rows of one table (`columns`, `table`), MAVLink is records of a tlog
(`tlog`); `recording` opens any file as either. `fuse` fuses a flight again, `convert` writes it in
another format, `play` and `opening` play it, `summary` describes it.
"""
