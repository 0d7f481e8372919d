"""A `RunDiff` as sections of sentences and tables."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from runner.analysis.diff import NOT_CONTENT, Cause, Change, Parting, RunDiff
from runner.analysis.sections import Grid, Section
from runner.environments.naming import spoken
from runner.util.humanize import UNKNOWN

MOST_NAMED = 4
"""So many settings are named in the first sentences."""


def sections(difference: RunDiff, everything: bool = False) -> list[Section]:
    """Return what is to be said of a difference.

    Args:
        difference: of two runs.
        everything: also the sections in which nothing differs, and metrics that do not.
    """
    made = [
        _runs(difference),
        _values("Configuration", difference, "config"),
        _environment(difference),
        _trajectory(difference),
        _evaluations(difference),
        _tables(difference),
        _metrics(difference, everything),
        _values("Costs", difference, "costs", _amount),
        _values("Provenance", difference, "provenance"),
    ]
    if everything:
        return [section if _says(section) else Section(section.title, ["the same"]) for section in made]
    return [section for section in made if _says(section)]


def _says(section: Section) -> bool:
    return bool(section.sentences or section.grids)


def _runs(difference: RunDiff) -> Section:
    rows = [
        (
            name,
            who["run_id"],
            who["name"],
            UNKNOWN if who["seed"] is None else str(who["seed"]),
            who["status"],
        )
        for name, who in (("A", difference.a), ("B", difference.b))
    ]
    grid = Grid(("", "id", "name", "seed", "status"), rows)
    notes = list(difference.notes)
    if difference.ignored:
        notes.append(f"left out as asked, though it differs: {', '.join(difference.ignored)}")
    return Section("Runs", [in_short(difference), *(f"Note: {note}." for note in notes)], [grid])


def in_short(difference: RunDiff) -> str:
    """Return the outcome in a few sentences: whether they differ, in which settings, from where on."""
    if difference.same_content:
        return "The content is the same, to the last byte."
    settings = [change for change in difference.config if change.path.split(".")[0] not in NOT_CONTENT]
    unfinished = [
        name for name, who in (("A", difference.a), ("B", difference.b)) if who["status"] != "finished"
    ]
    said = [f"{' and '.join(unfinished)} did not finish." if unfinished else "The content differs."]
    if settings:
        told = "; ".join(f"{c.path} ({_set(c.a)} in A, {_set(c.b)} in B)" for c in settings[:MOST_NAMED])
        more = f"; and {len(settings) - MOST_NAMED} more" if len(settings) > MOST_NAMED else ""
        said.append(f"Of the settings, {told}{more} {'differ' if len(settings) > 1 else 'differs'}.")
    else:
        other = "other " if difference.ignored else ""
        said.append(f"No {other}setting that determines the content differs.")
    parting = difference.parting
    if parting is not None and parting.step:
        said.append(f"Training is the same for {parting.step:,} steps.")
    elif parting is not None:
        said.append("Training differs from the first step on.")
    elif difference.overlap is not None:
        said.append("Training took the same steps.")
    elif difference.loop_evaluation is not None:
        said.append("Training took the same steps, evaluation did not.")
    return " ".join(said)


def _text(value: Any) -> str:
    return "–" if value is None else str(value)


def _amount(value: Any) -> str:
    return f"{value:,}" if isinstance(value, int | float) else _text(value)


def _values(title: str, difference: RunDiff, part: str, told: Callable[[Any], str] = _text) -> Section:
    """Return the values by path of a part: those that differ, and behind them those that are alike."""
    changes: list[Change] = getattr(difference, part)
    differ = [(change.path, told(change.a), told(change.b)) for change in changes]
    alike = [(path, told(value)) for path, value in difference.alike.get(part, {}).items()]
    grids = [Grid(("", "A", "B"), differ)] if differ else []
    return Section(title, grids=[*grids, *([Grid(("", "A and B"), alike)] if alike else [])])


def _environment(difference: RunDiff) -> Section:
    environment = difference.environment
    if environment.same:
        return Section("Environment")
    sentences = []
    if environment.transitions:
        share = environment.transitions / environment.of
        sentences.append(
            f"{environment.transitions:,} of {environment.of:,} (state, action) pairs ({share:.1%}) have "
            f"other outcomes; {len(environment.examples)} of them:"
        )
    if environment.other_starts:
        sentences.append("Episodes start in other states, or with other probabilities.")
    grids = []
    if environment.description:
        grids.append(
            Grid(("", "A", "B"), [(c.path, _text(c.a), _text(c.b)) for c in environment.description])
        )
    if environment.examples:
        rows = [(f"{change.state}: {change.action}", change.a, change.b) for change in environment.examples]
        grids.append(Grid(("state: action", "A", "B"), rows))
    return Section("Environment", sentences, grids)


def _trajectory(difference: RunDiff) -> Section:
    overlap, parting = difference.overlap, difference.parting
    sentences, grids = [], []
    if parting is not None and difference.cause is not None:
        sentences += _told(parting, difference.cause)
        grids += _q_rows(difference.cause)
    elif parting is not None:
        sentences.append(_of_loops(parting))
    elif overlap is not None:
        sentences.append("Training is the same, step by step.")
    if overlap is not None and parting is not None:
        share = overlap.equal_steps / overlap.compared_steps if overlap.compared_steps else math.nan
        sentences.append(
            f"Of the {overlap.episodes:,} episodes of both, {overlap.equal_episodes:,} are the same; of "
            f"their steps {share:.1%} agree at the same time of the same episode. Mean length "
            f"{overlap.mean_length_a:.1f} in A, {overlap.mean_length_b:.1f} in B."
        )
        sentences += visits_told(difference)
        grids += visits_grids(difference)
    return Section("Training", sentences, grids)


def visits_told(difference: RunDiff) -> list[str]:
    """Return how alike both runs' training visits states, in a sentence, if that is known."""
    visits = difference.visits
    if visits is None:
        return []
    return [
        f"A acted in {visits.states_a:,} states, B in {visits.states_b:,}; of their steps {visits.alike:.1%} "
        "spread over the states alike."
    ]


def visits_grids(difference: RunDiff) -> list[Grid]:
    """Return the states whose shares of all training steps differ most."""
    visits = difference.visits
    if visits is None or not visits.most_apart:
        return []
    rows = [(told.state, f"{told.a:,}", f"{told.b:,}") for told in visits.most_apart]
    return [Grid(("training steps in a state, where the shares differ most", "A", "B"), rows)]


def _evaluations(difference: RunDiff) -> Section:
    sentences, grids = [], []
    for parting, cause in difference.evaluations:
        sentences += [
            f"They part {where_in_words(parting)}: {cause.text}.",
            *evaluation_told(difference, cause),
        ]
        grids += _q_rows(cause)
    if difference.loop_evaluation is not None:
        sentences.append(_of_loops(difference.loop_evaluation))
    return Section("Evaluation", sentences, grids)


def _of_loops(parting: Parting) -> str:
    phase = "training" if parting.phase == "train" else "evaluation"
    where = f"at {phase} step {parting.step:,}, of episode {parting.episode:,} at time {parting.t:,}"
    field = parting.field.removeprefix("reset.")
    if field != parting.field:
        where = f"in the reset before {phase} step {parting.step:,}, of episode {parting.episode:,}"
    return f"They part {where}: {spoken(field)} is {_text(parting.a)} in A, {_text(parting.b)} in B."


def _told(parting: Parting, cause: Cause) -> list[str]:
    return [f"They part {where_in_words(parting)}: {cause.text}.", *updates_in_words(cause)]


def evaluation_told(difference: RunDiff, cause: Cause) -> list[str]:
    """Return how the tables came to differ that an evaluation used, in a sentence or two."""
    known = difference.cause
    if known is not None and known.update is not None and known.update == cause.update:
        return ["The tables came to differ by the same update as above."]
    if cause.kind == "greedy_action" and cause.update is None and known is not None:
        return ["Training had parted before, so the tables are not the same."]
    return updates_in_words(cause)


def where_in_words(parting: Parting) -> str:
    """Return where two runs part: `in training episode 70, at its step 360 (training step 46,202)`."""
    if parting.after is None:
        return f"in training episode {parting.episode:,}, at t = {parting.t} (training step {parting.step:,})"
    return (
        f"in the evaluation after {parting.after:,} training episodes, in trial {parting.episode:,}, "
        f"at t = {parting.t} (evaluation step {parting.step:,} of A)"
    )


def updates_in_words(cause: Cause) -> list[str]:
    """Return how the tables came to differ, in a sentence or two; none if that is not the cause."""
    update = cause.update
    if update is None:
        return []
    said = [
        f"The tables came to differ before, by the update of training step {update.step:,} in episode "
        f"{update.episode:,}: {spoken(update.agent)}'s value of {update.action} in the state "
        f"({update.state}) became {update.a:.6g} in A and {update.b:.6g} in B."
    ]
    if update.reasons:
        said.append(f"Why that update differs: {'; '.join(update.reasons)}.")
    return said


def _q_rows(cause: Cause) -> list[Grid]:
    """Return the Q-values of the state in which the greedy actions differ, the best of each agent."""
    grids = []
    for row in cause.rows:
        best = dict.fromkeys((_argmax(row.a), _argmax(row.b)))
        cells = [(row.actions[j], f"{row.a[j]:.6g}", f"{row.b[j]:.6g}") for j in best]
        grids.append(Grid((f"Q-values of {spoken(row.agent)} there, of the greedy actions", "A", "B"), cells))
    return grids


def _argmax(values: list[float]) -> int:
    return max(range(len(values)), key=values.__getitem__)


def _tables(difference: RunDiff) -> Section:
    differing = [table for table in difference.tables if table.largest > 0]
    if not differing:
        return Section("Q-tables")
    rows = [
        (
            f"{table.episode:,}",
            table.agent,
            f"{table.largest:.4g}",
            f"{table.mean:.4g}",
            f"{table.greedy_share:.1%}",
            "–" if math.isnan(table.greedy_share_visited) else f"{table.greedy_share_visited:.1%}",
        )
        for table in differing
    ]
    headings = ("episode", "agent", "largest", "mean", "other greedy action", "weighted by visits")
    last = differing[-1]
    cells = [(f"{cell.state}: {cell.action}", f"{cell.a:.6g}", f"{cell.b:.6g}") for cell in last.cells]
    where = Grid((f"largest, {last.agent}, episode {last.episode:,}", "A", "B"), cells)
    return Section("Q-tables", grids=[Grid(headings, rows), where])


def _metrics(difference: RunDiff, everything: bool) -> Section:
    shown = [metric for metric in difference.metrics if everything or not metric.same]
    rows = [
        (
            metric.name,
            f"{metric.end_a:,.2f}",
            f"{metric.end_b:,.2f}",
            f"{metric.end_b - metric.end_a:+,.2f}",
            "–" if math.isnan(metric.area) else f"{metric.area:+,.2f}",
        )
        for metric in shown
    ]
    grids = [Grid(("", "A at the end", "B at the end", "B - A", "mean B - A"), rows)] if rows else []
    crossings = [
        (f"{metric.name} reaches {level}", *("never" if at is None else f"episode {at:,}" for at in episodes))
        for metric in difference.metrics
        for level, episodes in metric.crossings.items()
    ]
    if crossings:
        grids.append(Grid(("first", "A", "B"), crossings))
    return Section("Metrics", grids=grids)


def _set(value: Any) -> str:
    return "not set" if value is None else str(value)
