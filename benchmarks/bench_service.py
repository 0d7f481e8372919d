"""Response times of the service with ten thousand runs."""

from __future__ import annotations

import dataclasses
import tempfile
from pathlib import Path
from typing import Final

from benchmarks.bench_catalogue import LISTED, many, one_run
from benchmarks.figures import Figure
from benchmarks.serving import Service, memory_of, percentile, response_times, serving
from runner.util.files import CACHE_VARIABLE
from runner.util.humanize import counted

CLIENTS: Final = 4
MEDIAN: Final = (300, 100)
NINETY_NINTH: Final = (1000, 300)
"""Targets in milliseconds: at least, and aim."""
SEARCHES: Final = [
    f"/api/v1/runs?filter=name=='experiment{k}'%20and%20config.discount%3E0.{k}&sort=-success_percent"
    for k in range(1, 38)
]


def measure(quick: bool) -> list[Figure]:
    """Return the milliseconds until a client has the complete response."""
    seconds = 2 if quick else 8
    with tempfile.TemporaryDirectory() as folder:
        environment = {CACHE_VARIABLE: f"{folder}/cache"}
        recordings = many(one_run(Path(folder, "one")), Path(folder, "many"), LISTED, recordings=False)
        with serving(recordings, environment=environment) as service:
            response_times(service, ["/api/v1/runs"], clients=1, seconds=1)
            found = _figures(service, "API list", ["/api/v1/runs"], CLIENTS, seconds)
            found += _figures(service, "runs page", ["/runs"], CLIENTS, seconds)
            alone, _ = _figures(service, "a search, one client", SEARCHES, 1, seconds)
            memory = memory_of(service.process)
    note = "with the processes it keeps ready; what they share is counted once"
    search = dataclasses.replace(alone, at_least=None, aim=None)
    return [*found, search, Figure("memory of the service then", memory, "MB", 400, 250, False, detail=note)]


def _figures(service: Service, what: str, paths: list[str], clients: int, seconds: float) -> list[Figure]:
    times = [1000 * taken for taken in response_times(service, paths, clients, seconds)]
    rate = len(times) / seconds
    detail = (
        f"{LISTED:,} runs; {counted(clients, 'client')} asking again as soon as answered, "
        f"{rate:,.0f} answers a second"
    )
    spread = (min(times), max(times))
    return [
        Figure(
            f"{what}, median",
            percentile(times, 50),
            "ms",
            *MEDIAN,
            higher_is_better=False,
            spread=spread,
            detail=detail,
        ),
        Figure(
            f"{what}, 99th percentile", percentile(times, 99), "ms", *NINETY_NINTH, higher_is_better=False
        ),
    ]
