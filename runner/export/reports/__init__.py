"""Self-contained pages about runs and comparisons."""
