"""The log workshop: a stream of frames, a chain of edits, a writer.

| step           | modules                                                                        |
| -------------- | ------------------------------------------------------------------------------ |
| stream         | `merging`, `joining`: one stream of batches or rows from several files         |
| chain          | `editing`: the chain; `selection`: which records; `anonymising`: their frames  |
| writer         | `convert`: one writer per format, chosen by the ending of the file             |
| single content | `extracts`, `timed_extracts`; `comparison` of two recordings                   |

A link of the chain takes batches and returns batches, or takes a frame and returns it edited, or
None. So the memory needed does not depend on the size of the files.
"""
