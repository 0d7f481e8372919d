"""`values`: what the agent of a checkpoint returns along a recorded episode."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

from runner.analysis.sections import Grid, Section
from runner.errors import ConfigError
from runner.util.row_text import csv_lines
from runner.views.view import NO_PROGRESS, ONLY_HERE, ReadyAnswer, ShownProgress, View

if TYPE_CHECKING:
    from runner.analysis.episodes import EpisodeRef
    from runner.runs.run import Run


def values(
    run: Run,
    episode: EpisodeRef | None = ONLY_HERE,
    trial: EpisodeRef | None = ONLY_HERE,
    checkpoint: str | None = ONLY_HERE,
    policy: str | None = ONLY_HERE,
    trust: bool = ONLY_HERE,
    progress: ShownProgress = NO_PROGRESS,
) -> ReadyAnswer:
    """Compute what the agent of a checkpoint of RUN returns at each step of a recorded episode.

    --policy names a function of yours that takes the checkpoint's content (arrays by name, or bytes) and the
    spaces of observations and actions, and returns a function. That is called with the recorded observation
    before each step, and returns a number, an array, or a mapping of names to these. A checkpoint that is a
    pickle is loaded only with --trust.

    Examples:
      dualtaxi values cartpole --episode 3 --checkpoint @20000 --policy agent:values
      dualtaxi values cartpole --episode 3 --checkpoint policy@0 --policy agent:values -o values.csv
    """
    from runner.loops.policies import values_along
    from runner.recording.reader import open_recording
    from runner.runs.checkpoints import find_checkpoint

    at = episode or trial
    if episode and trial:
        raise ConfigError("--episode and --eval exclude each other: choose one.")
    if at is None or checkpoint is None or policy is None:
        needed = {"--episode or --eval": at, "--checkpoint": checkpoint, "--policy": policy}
        lacking = [name for name, value in needed.items() if value is None]
        raise ConfigError(f"found no {', no '.join(lacking)}; see `dualtaxi values --help`.")
    chosen = find_checkpoint(run.checkpoints(), checkpoint, f"run {run.run_id}")
    with open_recording(run.recording) as recording, progress.stage("computing values"):
        at = at.resolved(recording)
        number = at.number_in(recording)
        along = values_along(recording, at.phase, number, chosen, policy, trust)
    columns: dict[str, list[object]] = {"t": list(range(len(along.rewards)))}
    columns |= _columns("action", along.actions) | _columns("reward", along.rewards.sum(axis=1))
    for name, returned in along.values.items():
        columns |= _columns(name, returned)
    rows = list(zip(*columns.values(), strict=True))
    data = {
        "run_id": run.run_id,
        "phase": at.phase,
        "episode": number,
        "checkpoint": chosen.as_json(),
        "policy": policy,
        "steps": [dict(zip(columns, row, strict=True)) for row in rows],
    }
    shown = [tuple(f"{x:.4g}" if isinstance(x, float) else str(x) for x in row) for row in rows]
    grid = Grid(tuple(columns), shown, left=(), cut=())
    return ReadyAnswer(data, [Section("", grids=[grid])], lambda: "".join(csv_lines(columns, rows)))


def _columns(name: str, values: Any) -> dict[str, list[object]]:
    """Return values, nested as their space, as a column for each number."""
    if isinstance(values, Mapping):
        parts = (_columns(f"{name}.{key}", part) for key, part in values.items())
        return {key: column for part in parts for key, column in part.items()}
    if isinstance(values, tuple):
        return _columns(name, {str(i): part for i, part in enumerate(values)})
    if isinstance(values, list) or values.ndim == 1:
        return {name: values if isinstance(values, list) else values.tolist()}
    flat = values.reshape(len(values), -1)
    return {f"{name}[{i}]": flat[:, i].tolist() for i in range(flat.shape[1])}


VIEW: Final = View(
    "values", "Values", values, subject="run", file_ending=".csv", file_help="Write a CSV file."
)
