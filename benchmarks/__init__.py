"""Benchmarks: how fast, how small, compared with the textbook way in the same run.

    python -m benchmarks [NAME ...] [--json FILE] [--quick]

A benchmark is a file `bench_NAME.py` with

    def measure(quick: bool) -> list[Figure]

where `quick` asks for fewer repetitions and shorter work. Nothing fails for being slow: the table puts
each figure beside what is to be reached, and the reader judges.
"""
