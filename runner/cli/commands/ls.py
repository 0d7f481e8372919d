"""`dualtaxi ls`: the recorded runs."""

from __future__ import annotations

import contextlib
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from runner.cli.options import json_option, recordings_option
from runner.cli.output import UNKNOWN, age, draw, number, print_json, say, size, table
from runner.runs import list_runs, recordings_folder

if TYPE_CHECKING:
    from runner.runs import Run


@click.command("ls")
@recordings_option
@json_option
def command(recordings: Path | None, as_json: bool) -> None:
    """List the runs of the recordings folder, the newest first.

    Shown are the training episodes done (of those to do, where some are missing), how many percent of the
    last evaluation's trials finished, the size of the recording, and how long ago the run began.

    \b
    Examples:
      dualtaxi ls
      dualtaxi ls --recordings /data/runs --json
    """  # noqa: D301 - Click wants the backspace itself
    folder = recordings_folder(recordings)
    runs = list_runs(folder)
    if as_json:
        print_json([_as_json(run) for run in runs])
    elif runs:
        _draw(runs)
    else:
        say(f"No runs in {folder} yet. `dualtaxi run CONFIG` makes one.")


def _as_json(run: Run) -> dict[str, Any]:
    last = run.summary.get("last_evaluation") or {}
    return {
        "run_id": run.run_id,
        "name": run.name,
        "config": _config_name(run),
        "seed": run.seed,
        "status": run.status,
        "episodes": run.summary.get("episodes"),
        "episodes_to_do": run.facts.get("config", {}).get("episodes"),
        "finish_percent": last.get("finish_percent"),
        "bytes": _bytes(run),
        "created": run.facts["created"],
        "path": str(run.recording.absolute()),
        "content_digest": run.summary.get("content_digest"),
    }


def _draw(runs: list[Run]) -> None:
    rows = [_as_json(run) for run in runs]
    renamed = any(row["name"] != row["config"] for row in rows)
    columns = ("id", "name", *(["config"] if renamed else []), "seed", "status")
    drawn = table(
        *columns,
        *("episodes", "finished %", "size", "age"),
        left=("id", "name", "config", "status"),
        shrinking=("name", "config"),
    )
    now = datetime.now(UTC)
    for run, row in zip(runs, rows, strict=True):
        done, to_do = row["episodes"], row["episodes_to_do"]
        told = UNKNOWN if done is None else f"{done:,}"
        drawn.add_row(
            row["run_id"],
            row["name"],
            *([row["config"]] if renamed else []),
            str(row["seed"]),
            row["status"],
            told if done == to_do or to_do is None else f"{told} of {to_do:,}",
            number(row["finish_percent"]),
            UNKNOWN if row["bytes"] is None else size(row["bytes"]),
            age((now - run.created).total_seconds()),
        )
    draw(drawn)


def _config_name(run: Run) -> str:
    return str(run.facts.get("config", {}).get("name", UNKNOWN))


def _bytes(run: Run) -> int | None:
    """Return the size of the recording now; None if there is none."""
    with contextlib.suppress(OSError):
        return run.recording.stat().st_size
    return None
