"""`dualtaxi show`: all about one run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from runner.analysis.sections import Grid, Section
from runner.cli.command import Command
from runner.cli.options import recordings_option, run_argument
from runner.cli.output import Reply, console, say, title
from runner.cli.progress import stage_line
from runner.cli.runs import command_for, find, restored
from runner.runs.branches import Origin, origin_in
from runner.util.humanize import UNKNOWN, ago, counted, duration, number, size

if TYPE_CHECKING:
    from runner.analysis.summary import RecordedExtras, RunDetails
    from runner.cli.output import Part
    from runner.recording.maker import Shard
    from runner.recording.run_file import Summary

MAX_PROCESSES: Final = 16
"""Names of processes shown."""
MAX_CYCLES: Final = 8
"""Cycles of states shown, in which episodes reach the step limit."""


@click.command("show", cls=Command)
def show_command(
    run_name: str = run_argument,
    recordings: Path | None = recordings_option,
) -> Reply:
    """Show a run: its evaluations, tables, configuration and provenance.

    --json also prints the whole series: `eval` has an object for each evaluation, with the training episodes
    before it, success_percent, mean_length, mean_penalties and the count of every event; `optimality` its
    exact measures, if the run takes them; `train` an object for each report of training; `loop` the last
    results of a loop: its last evaluation, the means of its last 100 training episodes and the last values it
    logged; `extras` the names of the values that it recorded with its steps; `first_resets` the seed and the
    options of the first reset of each phase; `checkpoints` those of its agent; `marks` the marks at its
    steps; `processes` the processes that recorded it together; `origin` the run and step that it was branched
    from; and `branches` its branches by run id.

    Examples:
      dualtaxi show @latest
      dualtaxi show k3v9m2xq --json
    """
    from runner.analysis.summary import describe_run
    from runner.runs.catalogue.index import look

    run = restored(find(run_name, recordings, newest=True))
    details = describe_run(run, say)
    folders = [] if run.stands_alone else [run.folder.parent]
    branches = look(folders, lambda index: index.branches(run.run_id), say)
    origin = origin_in(details.config)
    values = {
        "origin": None if origin is None else asdict(origin),
        "branches": {name: asdict(each) for name, each in branches.items()},
    }
    return Reply(details.as_json() | values, _text(details, branches))


def _text(details: RunDetails, branches: Mapping[str, Origin]) -> Iterator[Part]:
    from runner.analysis.summary import brief_provenance, random_policy_sentence
    from runner.cli.evaluations import evaluation_table
    from runner.recording.reader import open_recording
    from runner.recording.run_file import has_environment

    yield _head(details)
    given = dict(details.config)
    if (frames := given.get("frames")) and isinstance(frames, Mapping) and not frames.get("every"):
        del given["frames"]
    if not has_environment(given):
        del given["env"]
    parts: dict[str, Part] = {
        "Evaluations": evaluation_table(details.evaluations, details.success_events, console())
        if details.evaluations
        else "",
        "Last results": {}
        if details.loop is None
        else _loop_results(details.loop, has_environment(details.config)),
        "Values recorded with steps": _extras(details.extras),
        "Checkpoints": f"{len(details.checkpoints):,}, the last {details.checkpoints[-1].reference}; "
        f"`{command_for(details.run, 'checkpoints')}`"
        if details.checkpoints
        else "",
        "Marks": Grid(
            ("step", "text", "tags"),
            [(mark.at, mark.text, " ".join(mark.tags)) for mark in details.run.marks],
        )
        if details.run.marks
        else "",
        "Branches": {name: str(origin) for name, origin in branches.items()},
        "Greedy policy, exactly": _optimality(details),
        "Tables": {
            each.agent: UNKNOWN
            if each.step is None
            else f"{each.percent_filled:.1f} % filled, {each.zero_cells:,} cells are still zero, "
            f"after {each.step:,} steps"
            for each in details.tables
        },
        "Configuration": {key: _yaml(value) for key, value in given.items() if value not in ([], {})},
        "Provenance": brief_provenance(details.provenance),
    }
    for heading, part in parts.items():
        if part:
            yield title(heading)
            yield part
    if details.evaluations:  # after all else: it may take seconds to compute
        with stage_line("evaluating a random policy"), open_recording(details.run.recording) as recording:
            sentence = random_policy_sentence(recording)
        if sentence:
            yield Section("Baseline", [sentence])


def _head(details: RunDetails) -> dict[str, str]:
    from runner.recording.run_file import has_environment
    from runner.recording.schema import PHASE_NAMES

    run, summary, origin = details.run, details.run.summary, origin_in(details.config)
    took = "" if summary.seconds is None else f", took {duration(summary.seconds)}"
    steps = ""
    if has_environment(details.config) and not (
        details.train_steps is None or details.episodes is None or details.eval_steps is None
    ):
        steps = f"{details.train_steps:,} of training in {counted(details.episodes, 'episode')}, "
        steps += f"{details.eval_steps:,} of evaluation"
    clock, time = details.clock, ""
    if clock is not None and clock.steps_a_second is not None:
        time = f"{duration(clock.duration)} recorded"
        if details.train_steps or details.eval_steps:
            time += f", {clock.steps_a_second:,.0f} steps a second"
    return {
        "run": f"{run.run_id}  {run.title}",
        "status": f"{run.status}, begun {ago(run.created)} ago{took}",
        "damage": run.problem,
        "error": summary.error or "",
        "branch": "" if origin is None else f"of run {origin.run} {origin}",
        "processes": _processes(details.shards),
        "environment": str(details.environment or ""),
        "steps": steps,
        "first reset": "; ".join(
            f"{PHASE_NAMES[phase]} with {reset.in_words}"
            for phase, reset in details.first_resets.items()
            if reset.in_words
        ),
        "time": time,
        "digest": summary.content_digest or f"{UNKNOWN} (written when a run ends properly)",
        "file": f"{run.recording}  {size(details.bytes)}" if details.bytes else "no recording",
    }


def _processes(shards: Sequence[Shard]) -> str:
    """Return the names of the processes that recorded a run, and how they ended if not properly."""
    ill = [shard for shard in shards[1:] if shard.status != "finished"]  # the run has the status of the first
    names = [shard.name or "the one that began the run" for shard in shards[:MAX_PROCESSES]]
    more = [f"{len(shards) - MAX_PROCESSES:,} more"] if len(shards) > MAX_PROCESSES else []
    ends = [f"{shard.name} {shard.status}" for shard in ill[:MAX_PROCESSES]]
    ends += [f"{len(ill) - MAX_PROCESSES:,} more"] if len(ill) > MAX_PROCESSES else []
    return "; ".join(", ".join(part) for part in (names + more, ends) if part)


def _loop_results(loop: Summary, with_environment: bool) -> dict[str, str]:
    """Return the means of a loop's last training episodes and the values it logged last."""
    results = {"training": "no episode ended"} if with_environment else {}
    if (recent := loop.recent_training) and recent.episodes:
        episodes = f"last {recent.episodes:,} episodes" if recent.episodes > 1 else "one episode"
        means = f"mean return {number(recent.mean_return)}, mean length {number(recent.mean_length)}"
        results["training"] = f"{means} ({episodes})"
    for name, value in loop.logged.items():
        results[f"logged {name}"] = "not finite" if value is None else f"{value:,.6g}"
    return results


def _extras(extras: Mapping[str, RecordedExtras]) -> dict[str, str]:
    """Return the number of steps with extras, and dtype and shape of each name: `int64 [T]`."""
    from runner.recording.schema import PHASE_NAMES

    rows = {f"{PHASE_NAMES[phase]} steps": f"{own.steps:,}" for phase, own in extras.items()}
    for own in extras.values():
        for name, (dtype, shape) in own.names.items():
            lengths = ", ".join("T" if n is None else str(n) for n in shape)
            rows[name] = f"{dtype} [{lengths}]" if shape else dtype
    return rows


def _optimality(details: RunDetails) -> dict[str, str]:
    """Return the last exact measures, next to the optimum; empty without any."""
    from runner.environments.naming import states_in_words
    from runner.recording.reader import open_recording

    if not details.optimality:
        return {}
    measures = details.optimality[-1]
    with open_recording(details.run.recording) as recording:
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


def _yaml(value: object) -> str:
    """Return a value as YAML on one line."""
    import yaml

    text = yaml.safe_dump(value, default_flow_style=True, width=10**6, sort_keys=False)
    return text.removesuffix("\n").removesuffix("\n...")
