"""Jobs: stored in SQLite, checked before they are queued, and run by worker processes."""
