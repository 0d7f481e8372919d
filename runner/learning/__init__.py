"""Learning: a compiled kernel over transition arrays; it knows no files, no clock, no command line."""

from runner.learning.numba_cache import load_without_scipy, watch

load_without_scipy()
watch(__file__)
