"""The catalogue: `ls` over ten thousand runs, and rebuilding the index of a thousand recordings.

`python -m benchmarks.bench_catalogue 100000` measures time and peak memory of commands over 100,000 runs.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path

from benchmarks.bench_cold_start import command
from benchmarks.figures import Figure, figure
from benchmarks.processes import run, run_command
from runner.runs.run import RUN_FILE, list_runs
from runner.util.files import CACHE_VARIABLE

LISTED, RECORDED = 10_000, 1_000
SMALL = ("episodes=30", "env.kwargs={max_episode_steps: 40}", "evaluation.every=10", "evaluation.trials=5")
FILTER = 'status == "finished" and config.discount > 0.5 and "keep" not in tags'
DISK = """
import sys
from pathlib import Path
from runner.runs.catalogue.filters import Filter
from runner.runs.catalogue.index import look
from runner.runs.catalogue.usage import usage_of
place = Path(sys.argv[2])
_, sums = usage_of(lambda work: look([place], work, cached=True), Filter(None), 50)
sums.freeable([place])
"""
"""The work of the page `/disk` in a separate process, with an index that is up to date."""
OLD = 1_700_000_000
"""Modification time of the files: old enough for the index to trust it."""


def measure(quick: bool) -> list[Figure]:
    """Return the processor time of whole commands."""
    repetitions = 3 if quick else 10
    with tempfile.TemporaryDirectory() as folder:
        environment = {CACHE_VARIABLE: f"{folder}/cache", "COLUMNS": "120"}
        small = one_run(Path(folder, "one"))
        described = many(small, Path(folder, "described"), LISTED, recordings=False)
        recorded = many(small, Path(folder, "recorded"), RECORDED, recordings=True)
        for place in recorded.iterdir():
            if int(place.name[1:]) % 2:
                (place / RUN_FILE).unlink()

        def timed(*words: str, place: Path, times: int = repetitions) -> list[float]:
            line = [*command(*words), "--recordings", str(place)]
            return [run(line, environment).cpu_seconds for _ in range(times)]

        first = timed("ls", "--limit", "50", place=described, times=1)
        lists = timed("ls", "--limit", "50", place=described)
        filtered = timed("ls", "--limit", "50", "--sort", "-success_percent", FILTER, place=described)
        shown = timed("show", "r00042", place=described)
        reindexed = timed("index", "rebuild", place=recorded)
    note = f"{LISTED:,} runs; processor time of the whole command"
    return [
        figure("ls", lists, "s", (0.8, 0.4), higher_is_better=False, detail=note),
        figure("ls with a filter, sorted", filtered, "s", (0.8, 0.4), higher_is_better=False, detail=FILTER),
        figure("ls without an index", first, "s", higher_is_better=False),
        figure("show of a run by a prefix of its id", shown, "s", higher_is_better=False),
        figure(
            f"index rebuild of {RECORDED:,} recordings",
            reindexed,
            "s",
            (20, 5),
            higher_is_better=False,
            detail="small copies, half of them without run.json, which have to be opened",
        ),
    ]


def measure_many(count: int) -> list[Figure]:
    """Return processor seconds and peak memory of commands over very many runs without recordings."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {CACHE_VARIABLE: f"{folder}/cache", "COLUMNS": "120"}
        place = many(one_run(Path(folder, "one")), Path(folder, "many"), count, recordings=False)

        def measured(name: str, *words: str, times: int = 1) -> list[Figure]:
            line = [*words, "--recordings", str(place)]
            done = [run(line, environment) for _ in range(times)]
            seconds, peaks = [each.cpu_seconds for each in done], [each.peak_megabytes for each in done]
            return [
                figure(name, seconds, "s", higher_is_better=False, detail=f"{count:,} runs; processor time"),
                figure(f"  peak memory of {name}", peaks, "MB", higher_is_better=False),
            ]

        return [
            *measured("first ls", *command("ls", "--limit", "50")),
            *measured("ls", *command("ls", "--limit", "50"), times=3),
            *measured(
                "ls, filtered and sorted", *command("ls", "--sort", "-success_percent", FILTER), times=3
            ),
            *measured("first du", *command("du")),
            *measured("du", *command("du"), times=3),
            *measured("the page /disk", sys.executable, "-c", DISK, times=3),
            *measured("prune --dry-run", *command("prune", "--older-than", "1d", "--dry-run")),
            *measured("ls --json", *command("ls", "--json")),
        ]


def one_run(folder: Path) -> Path:
    """Return the folder of a small run."""
    run(run_command("cooperative", str(folder), *SMALL))
    (small,) = list_runs(folder)
    return small.folder


def many(small: Path, folder: Path, count: int, recordings: bool) -> Path:
    """Return a folder with copies of a run that have different ids, seeds, settings and results."""
    facts = json.loads((small / RUN_FILE).read_text())
    rng = random.Random(0)
    for number in range(count):
        place = folder / f"r{number:05}"
        if recordings:
            shutil.copytree(small, place)
        else:
            place.mkdir(parents=True)
            (place / "recording.mcap").write_bytes(b"")
        facts |= {"run_id": place.name, "seed": number % 10, "name": f"experiment{number % 37}"}
        facts["created"] = f"2026-{1 + number % 12:02}-{1 + number % 28:02}T10:00:00.{number % 1000:03}+00:00"
        facts["config"] |= {"discount": rng.random(), "name": facts["name"]}
        facts["summary"]["last_evaluation"] = {"success_percent": rng.uniform(0, 100)}
        facts["summary"]["content_digest"] = f"{rng.getrandbits(256):064x}"
        (place / RUN_FILE).write_text(json.dumps(facts, indent=1))
        age(place.iterdir())
    return folder


def age(paths: Iterable[Path]) -> None:
    """Set an old modification time."""
    for path in paths:
        os.utime(path, (OLD, OLD))


if __name__ == "__main__":
    for each in measure_many(int(sys.argv[1])):
        print(f"{each.what:40} {each.value:10.2f} {each.unit}")
