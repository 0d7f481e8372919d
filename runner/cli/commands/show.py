"""`dualtaxi show`: all about one run."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from runner.cli import Command
from runner.cli.options import json_option, recordings_option, run_argument
from runner.cli.output import console, draw, facts, print_json, say, title
from runner.cli.progress import stage_line
from runner.cli.runs import find, restored
from runner.util.humanize import UNKNOWN, age, duration, number, size

if TYPE_CHECKING:
    from rich.console import RenderableType

    from runner.recording.reader import Recording
    from runner.runs.run import Run

MAX_CYCLES: Final = 8
"""Cycles of states shown, in which episodes reach the step limit."""


@click.command("show", cls=Command)
@run_argument
@recordings_option
@json_option
def show_command(run_name: str, recordings: Path | None, as_json: bool) -> None:
    """Show a run: its evaluations, tables, configuration and provenance.

    With --json also the whole series: under `eval` an object for each evaluation, with the training episodes
    before it, success_percent, mean_length, mean_penalties and the count of every event; under `optimality`
    its exact measures, if the run takes them; under `train` one for each report of training; under `loop` the
    last results of a loop: its last evaluation, the means of its last 100 training episodes and the last
    values it logged.

    Examples:
      dualtaxi show @latest
      dualtaxi show k3v9m2xq --json
    """
    from runner.analysis.summary import describe_run

    run = restored(find(run_name, recordings))
    values = describe_run(run, say)
    if as_json:
        print_json(values)
    else:
        draw(*_parts(run, values))


def _parts(run: Run, values: dict[str, Any]) -> list[RenderableType]:
    from runner.analysis.summary import random_policy_sentence
    from runner.cli.evaluations import evaluation_table
    from runner.recording.reader import open_recording

    parts: list[RenderableType] = [facts(_head(run, values))]
    if values["eval"]:
        parts += [title("Evaluations"), evaluation_table(values["eval"], values["success_events"], console())]
        with stage_line("evaluating a random policy"), open_recording(run.recording) as recording:
            sentence = random_policy_sentence(recording)
        parts += [sentence] if sentence else []
    if values["loop"]:
        parts += [title("Last results"), facts(_loop_results(values["loop"]))]
    if values["optimality"]:
        with open_recording(run.recording) as recording:
            measures = _optimality(recording, values["optimality"][-1])
        parts += [title("Greedy policy, exactly"), facts(measures)]
    if values["tables"]:
        fill = {
            each["agent"]: f"{each['percent_filled']:.1f} % filled, {each['zero_cells']:,} cells are still "
            f"zero, after {each['step']:,} steps"
            if "step" in each
            else UNKNOWN
            for each in values["tables"]
        }
        parts += [title("Tables"), facts(fill)]
    config = {key: _yaml(value) for key, value in values["config"].items()}
    parts += [title("Configuration"), facts(config)]
    if values["provenance"]:
        parts += [title("Provenance"), facts(values["provenance"])]
    return parts


def _head(run: Run, values: dict[str, Any]) -> dict[str, str]:
    ago = age((datetime.now(UTC) - run.created).total_seconds())
    took = "" if values["seconds"] is None else f", took {duration(values['seconds'])}"
    steps = ""
    if None not in (values["train_steps"], values["episodes"], values["eval_steps"]):
        steps = f"{values['train_steps']:,} of training in {values['episodes']:,} episodes, "
        steps += f"{values['eval_steps']:,} of evaluation"
    head = {
        "run": f"{run.run_id}  {run.title}",
        "status": f"{values['status']}, begun {ago} ago{took}",
        "damage": values.get("damage", ""),
        "error": run.summary.error or "",
        "steps": steps,
        "digest": values["content_digest"] or f"{UNKNOWN} (written when a run ends properly)",
        "file": f"{run.recording}  {size(values['bytes'])}" if values["bytes"] else "no recording",
    }
    return {key: text for key, text in head.items() if text}


def _loop_results(loop: dict[str, Any]) -> dict[str, str]:
    """Return the means of a loop's last training episodes and the values it logged last."""
    recent = loop["recent_training"]
    episodes = f"last {recent['episodes']:,} episodes" if recent["episodes"] > 1 else "one episode"
    results = {"training": "no episode ended"}
    if recent["episodes"]:
        means = f"mean return {number(recent['mean_return'])}, mean length {number(recent['mean_length'])}"
        results["training"] = f"{means} ({episodes})"
    for name, value in loop["logged"].items():
        results[f"logged {name}"] = "not finite" if value is None else f"{value:,.6g}"
    return results


def _optimality(recording: Recording, measures: dict[str, Any]) -> dict[str, str]:
    """Return the last exact measures, next to the optimum."""
    from runner.environments.naming import states_in_words

    states = states_in_words(recording.mdp)
    gains = zip(recording.agents, measures["values"], measures["best_responses"], strict=True)
    gain = " and ".join(f"{best - own:.3f} ({agent})" for agent, own, best in gains)
    rows = {
        "succeeds": f"{measures['success_percent']:.1f} % of {measures['starts']:,} start states "
        f"(the optimum {measures['optimal_success_percent']:.1f} %)",
        "length": f"{measures['mean_length']:.2f} steps (the optimum {measures['optimal_mean_length']:.2f})",
        "value": f"{sum(measures['values']):.3f} of {measures['optimal_value']:.3f} that are possible",
        "to gain": f"{gain}, by a best response",
    }
    cycles = list(zip(*(measures[f"cycle_{key}"] for key in ("states", "lengths", "percents")), strict=True))
    lines = [
        f"{percent:.1f} %  {f'round {length} states' if length > 1 else 'one state'}: {states[state]}"
        for state, length, percent in cycles[:MAX_CYCLES]
    ]
    if len(cycles) > MAX_CYCLES:
        lines.append(f"and {len(cycles) - MAX_CYCLES:,} more cycles (--json)")
    return rows | ({"stuck in": "\n".join(lines)} if lines else {})


def _yaml(value: Any) -> str:
    """Return a value as YAML on one line."""
    import yaml

    text = yaml.safe_dump(value, default_flow_style=True, width=10**6, sort_keys=False)
    return text.removesuffix("\n").removesuffix("\n...")
