"""Learning: a compiled kernel over transition arrays; it knows no files, no clock, no command line."""

from runner.learning.compiling import leave_out_scipy, watch

leave_out_scipy()
watch(__file__)
