"""The log workshop: a stream of frames, a chain of edits, a writer.

`selection` chooses vehicles, messages and times, `trimming` states the times at which a cut begins
and ends, `merging` and `joining` make one stream of several files, `tlog_editing` edits frames on
their way, `anonymising` shifts locations and times; `convert` writes the stream in another format.
`extracts` and `timed_extracts` write single contents of a recording, and `comparison` compares two.
"""
