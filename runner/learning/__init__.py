"""Learning: a compiled kernel over transition arrays; it knows no files, no clock, no command line."""

from runner.compiled import watch

watch(__file__)
