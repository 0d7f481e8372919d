"""SQL over all steps of the tutorial's cooperative run, and over ten thousand runs: whole commands."""

from __future__ import annotations

import tempfile
from pathlib import Path

from benchmarks.bench_catalogue import many, one_run
from benchmarks.figures import Figure, command_seconds, peak_memory
from benchmarks.processes import dualtaxi, run, run_command

CONFIG = "tutorial_cooperative"
RUNS = 10_000
MEMORY = (500, 300)
VISITS = "SELECT state, action, count(*) AS visits FROM steps GROUP BY ALL ORDER BY visits DESC LIMIT 10"
EPISODE = "SELECT sum(reward) FROM steps WHERE phase = 'train' AND episode = 40000"
RETURNS = "SELECT config, seed, avg(mean_return) FROM runs GROUP BY ALL"


def measure(quick: bool) -> list[Figure]:
    """Return times and peak memory of commands; the index of runs is up to date."""
    repetitions = 3 if quick else 7
    with tempfile.TemporaryDirectory() as folder:
        run(run_command(CONFIG, folder))
        figures = [
            *_figures("all steps by state and action", folder, VISITS, repetitions, (1.5, 0.6)),
            *_figures("the steps of one episode", folder, EPISODE, repetitions, (1.5, 0.6)),
        ]
    with tempfile.TemporaryDirectory() as folder:
        place = many(one_run(Path(folder, "one")), Path(folder, "many"), RUNS, recordings=False)
        figures += _figures(f"mean return of {RUNS:,} runs", str(place), RETURNS, repetitions, (1, 0.3))
    return figures


def _figures(
    what: str, folder: str, query: str, repetitions: int, targets: tuple[float, float]
) -> list[Figure]:
    dualtaxi(folder, "sql", query)  # indexes the runs
    done = [dualtaxi(folder, "sql", query) for _ in range(repetitions)]
    return [command_seconds(f"sql: {what}", done, targets), peak_memory("  peak memory", done, MEMORY)]
