"""Two checkouts measured in turn: `python -m benchmarks.against CHECKOUT [NAME ...]`.

The benchmarks of this checkout run with the package of each, alternating, so that both sides see the same
machine. A checkout needs an environment of its own in `.venv`, as `make run` makes it.
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

HERE: Final = Path(__file__).resolve().parent
SIDES: Final = ("before", "now")


@dataclass
class Pair:
    """A figure of both sides."""

    unit: str
    higher_is_better: bool
    values: dict[str, list[float]] = field(default_factory=lambda: {side: [] for side in SIDES})

    @property
    def change(self) -> float | None:
        """By how much the figure grew, in percent; None if a side has none."""
        before, now = (self.values[side] for side in SIDES)
        if not before or not now or not statistics.median(before):
            return None
        return 100 * (statistics.median(now) / statistics.median(before) - 1)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure both checkouts and print their table; return 1 if a benchmark failed on a side."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.against", description=__doc__)
    parser.add_argument("checkout", type=Path, help="the other checkout, measured as `before`")
    parser.add_argument("names", nargs="*", metavar="NAME", help="the benchmarks to run, by default all")
    parser.add_argument("--repeat", type=int, default=2, help="how often each side is measured (default 2)")
    parser.add_argument("--quick", action="store_true", help="fewer repetitions, shorter work")
    options = parser.parse_args(arguments)
    names = options.names or sorted(path.stem.removeprefix("bench_") for path in HERE.glob("bench_*.py"))
    checkouts = {"before": options.checkout.resolve(), "now": HERE.parent}
    failed = False
    print(f"{'':<46}{'unit':<12}{'change':>9}   before; now", flush=True)
    with tempfile.TemporaryDirectory(prefix="dualtaxi-against-") as folder:
        shutil.copytree(HERE, Path(folder, "benchmarks"), ignore=shutil.ignore_patterns("__pycache__"))
        Path(folder, "configs").symlink_to(HERE.parent / "configs")
        for name in names:
            pairs: dict[str, Pair] = {}
            for repetition in range(options.repeat):
                for side in SIDES if repetition % 2 == 0 else SIDES[::-1]:
                    figures = measured(checkouts[side], name, Path(folder), options.quick)
                    failed |= figures is None
                    for row in figures or ():
                        pair = pairs.setdefault(row["what"], Pair(row["unit"], row["higher_is_better"]))
                        pair.values[side].append(row["value"])
            print(f"\n{name}")
            for what, pair in pairs.items():
                print(line(what, pair), flush=True)
    return int(failed)


def measured(checkout: Path, name: str, folder: Path, quick: bool) -> list[dict[str, Any]] | None:
    """Return the figures of a benchmark with a checkout's package; None if it failed.

    Args:
        folder: holds the copy of the benchmarks, and no package `runner` that would be imported instead.
    """
    result = folder / "figures.json"
    result.unlink(missing_ok=True)
    command = [str(checkout / ".venv" / "bin" / "python"), "-m", "benchmarks", name, "--json", str(result)]
    command += ["--quick"] if quick else []
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode or not result.exists():
        last = (done.stderr.strip() or done.stdout.strip()).splitlines()[-1:]
        print(f"    {checkout}: {name} failed: {''.join(last)}", file=sys.stderr)
        return None
    figures: list[dict[str, Any]] = json.loads(result.read_bytes())["figures"]
    return figures


def line(what: str, pair: Pair) -> str:
    """Return a line of the table: the change of the medians, and every measured value of both sides."""
    before, now = (", ".join(f"{value:.4g}" for value in pair.values[side]) or "-" for side in SIDES)
    change = pair.change
    text = "" if change is None else f"{change:+.1f} %"
    return f"{what:<46}{pair.unit:<12}{text:>9}   {before}; {now}"


if __name__ == "__main__":
    sys.exit(main())
