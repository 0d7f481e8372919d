"""Small functions that know nothing of runs: files, numbers in words, hashes."""
