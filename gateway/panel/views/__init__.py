"""The page's views, one a file; each builds itself from a `ViewContext`."""
