"""The command: `python -m benchmarks [NAME ...] [--json FILE] [--quick]`."""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import json
import os
import pkgutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import benchmarks
from benchmarks.figures import Figure, heading, row
from benchmarks.machine import OtherWork, machine

PREFIX = "bench_"
DISTURBING = 0.1
"""Cores used by other processes from which the table notes it."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmarks and print their table; always return 0."""
    names = sorted(
        module.name.removeprefix(PREFIX)
        for module in pkgutil.iter_modules(benchmarks.__path__)
        if module.name.startswith(PREFIX)
    )
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks", description="Measure speed, size and memory."
    )
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help=f"the benchmarks to run, by default all: {', '.join(names)}"
    )
    parser.add_argument("--json", metavar="FILE", type=Path, help="also write the figures to FILE")
    parser.add_argument("--quick", action="store_true", help="fewer repetitions, shorter work")
    options = parser.parse_args(arguments)
    unknown = [name for name in options.names if name not in names]
    if unknown:
        parser.error(f"no benchmark {unknown[0]!r}; there are {', '.join(names)}")

    facts = machine()
    print("\n".join(f"{key:<10} {value}" for key, value in facts.items()))
    print(f"\n{heading()}", flush=True)
    rows = []
    for name in options.names or names:
        print(f"\n{name}", flush=True)
        with OtherWork() as other:
            figures = _measure(name, options.quick)
        for figure in figures:
            print(row(figure), flush=True)
            rows.append({"benchmark": name, **dataclasses.asdict(figure), "standing": figure.standing})
            rows[-1]["other_work_cores"] = round(other.cores, 2)
        if other.cores > DISTURBING:
            print(f"    disturbed: other processes used {other.cores:.1f} cores", flush=True)
    if options.json:
        text = json.dumps({"machine": facts, "figures": rows}, indent=1, ensure_ascii=False)
        options.json.write_text(text + "\n", encoding="utf-8")
    return 0


def _measure(name: str, quick: bool) -> list[Figure]:
    module = importlib.import_module(f"benchmarks.{PREFIX}{name}")
    measured: list[Figure] = module.measure(quick)
    return measured


if __name__ == "__main__":
    with tempfile.TemporaryDirectory(prefix="dualtaxi-benchmarks-") as folder:
        tempfile.tempdir = folder  # recordings are written there and always removed
        os.environ["NUMBA_CACHE_DIR"] = str(Path(folder, "kernels"))  # before anything imports numba
        sys.exit(main())
