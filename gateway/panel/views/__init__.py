"""The page's views, one per file; each builds itself from a `ViewContext`."""
