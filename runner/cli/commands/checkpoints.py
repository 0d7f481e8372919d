"""`dualtaxi checkpoint get` and `dualtaxi values`: checkpoints that a loop recorded, and what they return."""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from runner.analysis.sections import Grid
from runner.cli.command import Command, CommandGroup, argument, option
from runner.cli.options import (
    checkpoint_option,
    episode_option,
    force_option,
    output_option,
    policy_option,
    trial_option,
    trust_option,
)
from runner.cli.output import Reply, csv_lines, path_and_size, written
from runner.cli.parameter_types import PATH
from runner.cli.progress import stage_line
from runner.cli.runs import recorded_run
from runner.export.places import new_file, write_text_new
from runner.runs.run import Run

if TYPE_CHECKING:
    from runner.analysis.episodes import EpisodeRef


@click.group("checkpoint", cls=CommandGroup)
def checkpoint_command() -> None:
    """Get a checkpoint of a run.

    Example:
      dualtaxi checkpoint get cartpole @latest -o policy.safetensors
    """


@checkpoint_command.command("get", short_help="Write a checkpoint into a file.")
def get_command(
    run: Run = recorded_run,
    reference: str = argument(metavar="[NAME]@STEP", default="@latest"),
    output: Path | None = output_option("NAME-STEP.FORMAT"),
    force: bool = force_option,
) -> Reply:
    """Write a checkpoint of RUN into a file, after comparing its digest.

    @STEP is the last checkpoint at or before that step, NAME@STEP the last one of that name; @latest is the
    last of all, and the default. Nothing is unpickled.

    Examples:
      dualtaxi checkpoint get cartpole @20000 -o policy.safetensors
      dualtaxi checkpoint get cartpole policy@latest -o policy.safetensors
    """
    from runner.runs.checkpoints import find_checkpoint

    checkpoint = find_checkpoint(run.checkpoints(), reference, f"run {run.run_id}")
    name = re.sub(r"[^\w.+=-]", "_", checkpoint.name)
    path = output or Path(f"{name}-{checkpoint.step}.{checkpoint.format}")
    checkpoint.check()
    with new_file(path, force) as temporary:
        shutil.copyfile(checkpoint.path, temporary)
    text = f"{path_and_size(path)}, {checkpoint.reference}, {checkpoint.format}"
    return written(text, path, **checkpoint.as_json())


@click.command("values", cls=Command)
def values_command(
    run: Run = recorded_run,
    episode: EpisodeRef | None = episode_option,
    trial: EpisodeRef | None = trial_option,
    checkpoint: str | None = checkpoint_option,
    policy: str | None = policy_option,
    output: Path | None = option("-o", "--output", type=PATH, metavar="FILE.csv", help="Write a CSV file."),
    force: bool = force_option,
    trust: bool = trust_option,
) -> Reply:
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
    if checkpoint is None or policy is None or at is None or (episode and trial):
        raise click.UsageError("expected --episode N or --eval N:TRIAL, --checkpoint and --policy.")
    chosen = find_checkpoint(run.checkpoints(), checkpoint, f"run {run.run_id}")
    with open_recording(run.recording) as recording, stage_line("computing values"):
        at = at.resolved(recording)
        number = at.number_in(recording)
        along = values_along(recording, at.phase, number, chosen, policy, trust)
    columns: dict[str, list[object]] = {"t": list(range(len(along.rewards)))}
    columns |= _columns("action", along.actions) | _columns("reward", along.rewards.sum(axis=1))
    for name, values in along.values.items():
        columns |= _columns(name, values)
    rows = list(zip(*columns.values(), strict=True))
    about = {
        "run_id": run.run_id,
        "phase": at.phase,
        "episode": number,
        "checkpoint": chosen.as_json(),
        "policy": policy,
        "steps": [dict(zip(columns, row, strict=True)) for row in rows],
    }
    if output is not None:
        write_text_new(output, force, "".join(csv_lines(columns, rows)))
        return written(f"{path_and_size(output)}, {len(rows):,} steps", output, **about)
    shown = [tuple(f"{x:.4g}" if isinstance(x, float) else str(x) for x in row) for row in rows]
    return Reply(about | {"files": []}, [Grid(tuple(columns), shown, left=(), cut=())])


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
