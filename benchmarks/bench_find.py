"""Find: episodes among those of a thousand runs of five thousand episodes, once they are indexed."""

from __future__ import annotations

import tempfile
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from benchmarks.bench_catalogue import many, one_run
from benchmarks.bench_cold_start import command
from benchmarks.figures import Figure, figure
from benchmarks.processes import run
from benchmarks.serving import percentile, response_times, serving
from runner.util.files import CACHE_VARIABLE, CACHED_EPISODES, cache_folder

RUNS, EPISODES_OF_RUN, CLIENTS = 1_000, 5_000, 20
EXPRESSIONS = (
    "ret < -100 and count(collision) >= 2 and length > 20",
    'any(action == "north + east") and never(collision)',
    "count(pickup) > 400",
)


def measure(quick: bool) -> list[Figure]:
    """Return seconds and peak memory of whole commands."""
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        environment = {CACHE_VARIABLE: f"{folder}/cache", "COLUMNS": "120"}
        patch.setenv(CACHE_VARIABLE, environment[CACHE_VARIABLE])
        place = many(one_run(Path(folder, "one")), Path(folder, "runs"), RUNS, recordings=True)
        line = [*command("find"), "--recordings", str(place), "--sort", "ret"]
        run([*line, "length > 0"], environment)
        _write_many_episodes()
        figures = []
        for expression in EXPRESSIONS:
            done = [run([*line, expression], environment) for _ in range(3 if quick else 10)]
            seconds, peaks = [each.seconds for each in done], [each.peak_megabytes for each in done]
            note = f"{RUNS:,} runs of {EPISODES_OF_RUN:,} episodes; the whole command"
            figures += [
                figure(f"find {expression}", seconds, "s", (1, 0.3), higher_is_better=False, detail=note),
                figure("  peak memory", peaks, "MB", (500, 300), higher_is_better=False),
            ]
        with serving(place, environment=environment) as service:
            page = f"/find?expression={quote(EXPRESSIONS[0])}&sort=ret"
            response_times(service, [page], clients=1, seconds=1)
            times = [1000 * taken for taken in response_times(service, [page], CLIENTS, 3 if quick else 10)]
    median, note = percentile(times, 50), f"{CLIENTS} clients ask the same; an answer is kept for seconds"
    return [*figures, Figure("page of hits, median", median, "ms", 100, 30, False, detail=note)]


def _write_many_episodes() -> None:
    """Replace the rows of each index by many, drawn from them."""
    for number, path in enumerate(sorted((cache_folder() / CACHED_EPISODES).glob("*.parquet"))):
        table = pq.read_table(path)
        chosen = np.random.default_rng(number).integers(len(table), size=EPISODES_OF_RUN)
        rows = table.take(chosen)
        for name in {"episode", "row"} & set(rows.column_names):
            at = rows.column_names.index(name)
            rows = rows.set_column(at, name, pa.array(np.arange(EPISODES_OF_RUN)))
        pq.write_table(rows, path, compression="zstd")


if __name__ == "__main__":
    for each in measure(quick=True):
        print(each.what, round(each.value, 3), each.unit)
