"""Learning: a compiled kernel over transition arrays; it knows no files, no clock, no command line."""
