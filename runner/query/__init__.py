"""Questions over many runs at once: their tables in SQL, read no further than a question needs."""
