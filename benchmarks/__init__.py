"""Benchmarks of speed, size and memory, each against a reference in the same run.

    python -m benchmarks [NAME ...] [--json FILE] [--quick]

A benchmark is a file `bench_NAME.py` with

    def measure(quick: bool) -> list[Figure]

where `quick` means fewer repetitions and shorter work. No benchmark fails for being slow: the table lists
each figure with its targets.
"""
