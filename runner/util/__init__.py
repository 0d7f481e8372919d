"""General helpers that know nothing of runs: values, files, formatting, optional packages, processes."""
