"""`dualtaxi show`: all about one run."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from runner.cli.options import json_option, recordings_option, run_argument
from runner.cli.output import console, draw, facts, print_json, say, title
from runner.cli.progress import stage_line
from runner.cli.runs import find, restored
from runner.util.humanize import UNKNOWN, age, duration, number, size

if TYPE_CHECKING:
    from rich.console import RenderableType

    from runner.runs.run import Run

MOST_CYCLES: Final = 8
"""So many of the cycles that time-outs are stuck in are told."""


@click.command("show")
@run_argument
@recordings_option
@json_option
def command(run_name: str, recordings: Path | None, as_json: bool) -> None:
    """Show a run: its evaluations, tables, configuration and provenance.

    With --json also the whole series: under `eval` an object for each evaluation, with the training episodes
    before it, success_percent, mean_length, mean_penalties and the count of every event; under `optimality`
    its exact measures, if the run takes them; under `train` one for each report of training; under `loop` the
    last results of a loop: its last evaluation, the means of its last 100 training episodes and the last
    values it logged.

    \b
    Examples:
      dualtaxi show @latest
      dualtaxi show k3v9m2xq --json
    """  # noqa: D301 - Click wants the backspace itself
    run = restored(find(run_name, recordings))
    from runner.analysis.summary import described

    told = described(run, say)
    if as_json:
        print_json(told)
    else:
        _draw(run, told)


def _draw(run: Run, told: dict[str, Any]) -> None:
    from runner.cli.evaluations import evaluation_table

    parts: list[RenderableType] = [facts(_head(run, told))]
    if told["eval"]:
        parts += [title("Evaluations"), evaluation_table(told["eval"], told["success_events"], console())]
        random = _random_policy(run)
        parts += [random] if random else []
    if told["loop"]:
        parts += [title("Last results"), facts(_loop_results(told["loop"]))]
    if told["optimality"]:
        parts += [title("Greedy policy, exactly"), facts(_exactly(run, told["optimality"][-1]))]
    if told["tables"]:
        fill = {table["agent"]: _fill_in_words(table) for table in told["tables"]}
        parts += [title("Tables"), facts(fill)]
    parts += [title("Configuration"), facts({key: _yaml(value) for key, value in told["config"].items()})]
    if told["provenance"]:
        parts += [title("Provenance"), facts(told["provenance"])]
    draw(*parts)


def _head(run: Run, told: dict[str, Any]) -> dict[str, str]:
    ago = age((datetime.now(UTC) - run.created).total_seconds())
    head = {
        "run": f"{run.run_id}  {run.title}",
        "status": f"{told['status']}, begun {ago} ago"
        + (f", took {duration(told['seconds'])}" if told["seconds"] is not None else ""),
    }
    if "damage" in told:
        head["damage"] = told["damage"]
    if run.summary.error:
        head["error"] = run.summary.error
    if None not in (told["train_steps"], told["episodes"], told["eval_steps"]):
        head["steps"] = (
            f"{told['train_steps']:,} of training in {told['episodes']:,} episodes, "
            f"{told['eval_steps']:,} of evaluation"
        )
    return head | {
        "digest": told["content_digest"] or f"{UNKNOWN} (told when a run ends properly)",
        "file": f"{run.recording}  {size(told['bytes'])}" if told["bytes"] else "no recording",
    }


def _random_policy(run: Run) -> str:
    """Return what a random policy achieves, as a sentence or nothing: what an evaluation compares with."""
    from runner.analysis.summary import random_policy_sentence
    from runner.recording.reader import open_recording

    with stage_line("computing what a random policy achieves"), open_recording(run.recording) as recording:
        return random_policy_sentence(recording)


def _loop_results(loop: dict[str, Any]) -> dict[str, str]:
    """Return the means of the last training episodes of a loop and the values it logged last."""
    recent = loop["recent_training"]
    episodes = f"last {recent['episodes']:,} episodes" if recent["episodes"] > 1 else "one episode"
    results = {"training": "no episode ended"}
    if recent["episodes"]:
        results = {
            "training": f"mean return {number(recent['mean_return'])}, mean length "
            f"{number(recent['mean_length'])} ({episodes})"
        }
    for name, value in loop["logged"].items():
        results[f"logged {name}"] = "not finite" if value is None else f"{value:,.6g}"
    return results


def _exactly(run: Run, measures: dict[str, Any]) -> dict[str, str]:
    """Return what the last exact measures say, beside what is possible."""
    from runner.environments.naming import states_in_words
    from runner.recording.reader import open_recording

    with open_recording(run.recording) as recording:
        words, agents = states_in_words(recording.mdp), recording.agents
    gain = " and ".join(
        f"{best - own:.3f} ({agent})"
        for agent, own, best in zip(agents, measures["values"], measures["best_responses"], strict=True)
    )
    told = {
        "succeeds": f"{measures['success_percent']:.1f} % of {measures['starts']:,} start states "
        f"(the optimum {measures['optimal_success_percent']:.1f} %)",
        "length": f"{measures['mean_length']:.2f} steps (the optimum {measures['optimal_mean_length']:.2f})",
        "value": f"{sum(measures['values']):.3f} of {measures['optimal_value']:.3f} that are possible",
        "to gain": f"{gain}, by a best response",
    }
    cycles = list(zip(*(measures[f"cycle_{key}"] for key in ("states", "lengths", "percents")), strict=True))
    if cycles:
        lines = [
            f"{percent:.1f} %  {f'round {length} states' if length > 1 else 'one state'}: {words[state]}"
            for state, length, percent in cycles[:MOST_CYCLES]
        ]
        more = len(cycles) - MOST_CYCLES
        told["stuck in"] = "\n".join([*lines, *([f"and {more:,} more cycles (--json)"] if more > 0 else [])])
    return told


def _fill_in_words(table: dict[str, Any]) -> str:
    if "step" not in table:
        return UNKNOWN
    return (
        f"{table['percent_filled']:.1f} % filled, {table['zero_cells']:,} cells are still zero, "
        f"after {table['step']:,} steps"
    )


def _yaml(value: Any) -> str:
    """Return a value as a configuration would say it, on one line."""
    import yaml

    text = yaml.safe_dump(value, default_flow_style=True, width=10**6, sort_keys=False)
    return text.removesuffix("\n").removesuffix("\n...")
