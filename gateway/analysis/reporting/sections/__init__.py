"""The sections of the report, one file a topic: numbers, pictures and what one sees."""
