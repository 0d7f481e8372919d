"""Learning: a compiled kernel over transition arrays; it knows no files, no clock, no command line."""

from runner.learning.numba_cache import watch

watch(__file__)
