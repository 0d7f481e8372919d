"""A `RunDiff` as sections of sentences and tables."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Final

from runner.analysis.diff import NOT_CONTENT, RunDiff
from runner.analysis.diff.causes import Cause
from runner.analysis.diff.code import FileChange, code_changes, made_in_words
from runner.analysis.diff.divergence import Divergence
from runner.analysis.sections import Grid, Section
from runner.environments.naming import spoken
from runner.errors import shortened
from runner.recording.reader import Recording
from runner.runs.branches import PATHS
from runner.util.differences import Change, changes_in
from runner.util.humanize import UNKNOWN, counted, setting

_MAX_SETTINGS: Final = 4
"""Settings that are named in the first sentences."""
_MAX_TEXT: Final = 80
"""Characters of a value."""
_MAX_VALUES: Final = 6
"""Q-values of each run that are listed where everything is: the highest."""


def sections(difference: RunDiff, everything: bool = False) -> list[Section]:
    """Return the text of a difference; `everything` includes what does not differ."""
    most = _MAX_VALUES if everything else 1
    all_sections = [
        _runs(difference),
        _values("Configuration", difference, "config", setting),
        _environment(difference),
        _training(difference, most),
        _evaluation(difference, most),
        _tables(difference),
        _metrics(difference, everything),
        _values("Costs", difference, "costs", _amount),
        _code(difference.code),
        _values("Provenance", difference, "provenance"),
    ]
    if everything:
        return [
            section if section.sentences or section.grids else Section(section.title, ["the same"])
            for section in all_sections
            if section.sentences or section.grids or section.title not in difference.not_compared
        ]
    return [section for section in all_sections if section.sentences or section.grids]


def _runs(difference: RunDiff) -> Section:
    rows = [
        (
            name,
            run["run_id"],
            run["name"],
            UNKNOWN if run["seed"] is None else str(run["seed"]),
            run["status"],
        )
        for name, run in (("A", difference.a), ("B", difference.b))
    ]
    notes = list(difference.notes)
    if difference.ignored:
        notes.append(f"ignored, though it differs: {', '.join(difference.ignored)}")
    grid = Grid(("", "id", "name", "seed", "status"), rows)
    return Section("Runs", [summary(difference)] + [f"Note: {note}." for note in notes], [grid])


def summary(difference: RunDiff) -> str:
    """Return the outcome in a few sentences: whether they differ, in which settings, from where on."""
    if difference.same_content:
        return "The content is the same, to the last byte."
    runs = (("A", difference.a), ("B", difference.b))
    unfinished = [name for name, run in runs if run["status"] != "finished"]
    sentences = [f"{' and '.join(unfinished)} did not finish." if unfinished else "The content differs."]
    cause = difference.cause or difference.evaluation_cause
    is_branch = cause is not None and cause.kind == "branch"
    settings = [
        change
        for change in difference.config
        if change.path.split(".")[0] not in NOT_CONTENT and not (is_branch and change.path in PATHS)
    ]
    if settings:
        pairs = [(c.path, *_shortened_pair(setting(c.a), setting(c.b))) for c in settings]
        named = [f"{path} ({a} in A, {b} in B)" for path, a, b in pairs]
        if len(named) > _MAX_SETTINGS:
            named[_MAX_SETTINGS:] = [f"and {len(named) - _MAX_SETTINGS} more"]
        listed = "; ".join(named)
        sentences.append(f"Of the settings, {listed} {'differ' if len(settings) > 1 else 'differs'}.")
    elif not is_branch:
        other = "other " if difference.ignored else ""
        sentences.append(f"No {other}setting that determines the content differs.")
    if made := made_in_words(difference.code, difference.provenance):
        sentences.append(f"How they were made differs: {', '.join(made)}.")
    divergence = difference.divergence
    if is_branch and cause is not None:
        sentences.append(f"{cause.text}.")
    elif divergence is not None and divergence.step:
        what = "Training takes the same actions" if divergence.actions_alone else "Training is the same"
        sentences.append(f"{what} for {counted(divergence.step, 'step')}.")
    elif divergence is not None:
        sentences.append("Training differs from the first step on.")
    elif difference.overlap is not None:
        sentences.append("Training took the same steps.")
    elif difference.evaluation_divergence is not None:
        sentences.append("Training took the same steps, evaluation did not.")
    return " ".join(sentences)


def _text(value: object) -> str:
    return UNKNOWN if value is None else setting(value)


def _shortened_pair(a: str, b: str) -> tuple[str, str]:
    """Return two texts, of long ones a part from shortly before where they differ."""
    if max(len(a), len(b)) <= _MAX_TEXT:
        return a, b
    differ = (i for i, pair in enumerate(zip(a, b, strict=False)) if pair[0] != pair[1])
    same = next(differ, min(len(a), len(b)))
    start = max(same - _MAX_TEXT // 4, 0)
    first, second = (shortened(f"…{text[start:]}" if start else text, _MAX_TEXT) for text in (a, b))
    return first, second


def _amount(value: object) -> str:
    return f"{value:,}" if isinstance(value, int | float) else _text(value)


def _values(title: str, difference: RunDiff, field: str, text: Callable[[object], str] = _text) -> Section:
    """Return the values by path of a field: those that differ, then those that are alike."""
    changes: list[Change] = getattr(difference, field)
    values = difference.alike.get(field, {}).items()
    alike = [(path, shortened(text(value), _MAX_TEXT)) for path, value in values]
    same = [Grid(("", "A and B"), alike)] if alike else []
    return Section(title, grids=[*_changes_grid(changes, text), *same])


def _changes_grid(changes: Sequence[Change], text: Callable[[object], str] = _text) -> list[Grid]:
    """Return a table of values by path in both runs; none without any."""
    rows = [(change.path, *_shortened_pair(text(change.a), text(change.b))) for change in changes]
    return [Grid(("", "A", "B"), rows)] if rows else []


def made_sections(a: Recording, b: Recording) -> tuple[str, list[Section]]:
    """Return how differently two runs were made: in a sentence, and the code and all of the provenance."""
    files, changes = code_changes(a, b), changes_in(a.provenance, b.provenance)
    provenance = Section("How they were made", [] if changes else ["the same"], _changes_grid(changes))
    missing = [f"{name} has no recorded code." for name, run in (("A", a), ("B", b)) if not run.code.files]
    code = _code(files)
    if not code.sentences:
        code = Section("Code", missing or ["the same, as far as it is recorded"])
    made = ", ".join(made_in_words(files, changes))
    return f"How they were made differs: {made}." if made else "", [code, provenance]


def _code(files: Sequence[FileChange]) -> Section:
    """Return the files of the user's code that differ, with the lines that do."""
    sentences, diffs = [], []
    for change in files:
        more = f"; {change.left_out:,} lines of the diff are not shown" if change.left_out else ""
        sentences.append(f"{change.words}: {change.added:,} added, {change.removed:,} removed{more}.")
        if change.lines:
            diffs.append(change.lines)
    return Section("Code", sentences, diffs=diffs)


def _environment(difference: RunDiff) -> Section:
    environment = difference.environment
    sentences = []
    grids = _changes_grid(environment.description)
    if environment.transitions:
        share = environment.transitions / environment.of
        sentences.append(
            f"{environment.transitions:,} of {environment.of:,} (state, action) pairs ({100 * share:.1f} %) "
            f"have other outcomes; {len(environment.examples)} of them:"
        )
    if environment.other_starts:
        sentences.append("Episodes start in other states, or with other probabilities.")
    if environment.examples:
        rows = [(f"{change.state}: {change.action}", change.a, change.b) for change in environment.examples]
        grids.append(Grid(("state: action", "A", "B"), rows))
    return Section("Environment", sentences, grids)


def _training(difference: RunDiff, most: int) -> Section:
    divergence, cause = difference.divergence, difference.cause
    if divergence is None:
        same = [] if difference.overlap is None else ["Training is the same, step by step."]
        return Section("Training", same)
    sentences = [divergence_in_words(divergence, cause), *_updates_in_words(cause)]
    grids = _q_rows(cause, most)
    if (overlap := difference.overlap) is not None:
        share = overlap.equal_steps / overlap.compared_steps if overlap.compared_steps else math.nan
        sentences.append(
            f"Of the {overlap.episodes:,} episodes of both, {overlap.equal_episodes:,} are the same; of "
            f"their steps {100 * share:.1f} % agree at the same time of the same episode. Mean length "
            f"{overlap.mean_length_a:.1f} in A, {overlap.mean_length_b:.1f} in B."
        )
    if (visits := difference.visits) is not None:
        sentences.append(
            f"A acted in {visits.states_a:,} states, B in {visits.states_b:,}; their distributions over the "
            f"states overlap by {100 * visits.alike:.1f} %."
        )
        if rows := [(state.state, f"{state.a:,}", f"{state.b:,}") for state in visits.most_apart]:
            grids.append(Grid(("training steps in a state, where the shares differ most", "A", "B"), rows))
    return Section("Training", sentences, grids)


def _evaluation(difference: RunDiff, most: int) -> Section:
    divergence, cause = difference.evaluation_divergence, difference.evaluation_cause
    if divergence is None:
        return Section("Evaluation")
    where = divergence_in_words(divergence, cause)
    return Section("Evaluation", [where, *_evaluation_updates(difference, cause)], _q_rows(cause, most))


def divergence_in_words(divergence: Divergence, cause: Cause | None) -> str:
    """Return where two runs diverge and why, as far as that is known, in a sentence."""
    if cause is not None:
        why = cause.text
    elif divergence.field == "digest":
        why = "the actions are the same, but observations or rewards differ"
    elif divergence.field == "step":
        has, lacks = ("B", "A") if _is_beyond_a(divergence) else ("A", "B")
        why = f"{has} has that step, {lacks} ended before it"
    else:  # how they learn is not known: the values that differ
        name = spoken(divergence.field.removeprefix("reset."))
        a, b = _shortened_pair(_text(divergence.a), _text(divergence.b))
        why = f"{name} is {a} in A, {b} in B"
    return f"They diverge {where_in_words(divergence)}: {why}."


def _evaluation_updates(difference: RunDiff, cause: Cause | None) -> list[str]:
    """Return how the tables came to differ that an evaluation used, in a sentence or two."""
    training_cause = difference.cause
    if cause is not None and training_cause is not None:
        if training_cause.update is not None and training_cause.update == cause.update:
            return ["The tables came to differ by the same update as above."]
        if cause.kind == "greedy_action" and cause.update is None:
            return ["Training had diverged before, so the tables are not the same."]
    return _updates_in_words(cause)


def _is_beyond_a(divergence: Divergence) -> bool:
    """Return whether only B has the step."""
    return divergence.field == "step" and divergence.a == "none"


def where_in_words(divergence: Divergence) -> str:
    """Return where two runs diverge: `in training episode 70, at t = 360 (training step 46,202)`."""
    step, episode = f"training step {divergence.step:,}", f"training episode {divergence.episode:,}"
    if divergence.phase == "eval":
        after = 0 if divergence.after is None else divergence.after
        step = f"evaluation step {divergence.step:,} of {'B' if _is_beyond_a(divergence) else 'A'}"
        episode = f"the evaluation after {after:,} training episodes, in trial {divergence.episode:,}"
    if divergence.field == "digest":
        return f"in {episode}, at {step} at the latest"
    if divergence.field.startswith("reset."):
        return f"in the reset before {step}, in {episode}"
    return f"in {episode}, at t = {divergence.t} ({step})"


def _updates_in_words(cause: Cause | None) -> list[str]:
    """Return how the tables came to differ, in a sentence or two; none if that is not the cause."""
    if cause is None or cause.update is None:
        return []
    update = cause.update
    sentences = [
        f"The tables came to differ before, by the update of training step {update.step:,} in episode "
        f"{update.episode:,}: {spoken(update.agent)}'s value of {update.action} in the state "
        f"({update.state}) became {update.a:.6g} in A and {update.b:.6g} in B."
    ]
    if update.reasons:
        sentences.append(f"Why that update differs: {'; '.join(update.reasons)}.")
    return sentences


def _q_rows(cause: Cause | None, most: int) -> list[Grid]:
    """Return the highest Q-values of both runs in the state in which the greedy actions differ."""
    grids = []
    if cause is not None:
        for row in cause.rows:
            orders = [sorted(range(len(values)), key=lambda j: -values[j]) for values in (row.a, row.b)]
            actions_in_row = dict.fromkeys(j for order in orders for j in order[:most])
            cells = []
            for j in actions_in_row:
                greedy = " and ".join(name for name, order in zip("AB", orders, strict=True) if j == order[0])
                name = f"{row.actions[j]} (greedy in {greedy})" if greedy else row.actions[j]
                cells.append((name, f"{row.a[j]:.6g}", f"{row.b[j]:.6g}"))
            of = f", the highest of {len(row.actions)}" if len(row.actions) > len(actions_in_row) else ""
            grids.append(Grid((f"Q-values of {spoken(row.agent)} there{of}", "A", "B"), cells))
    return grids


def _tables(difference: RunDiff) -> Section:
    differing = [table for table in difference.tables if table.largest > 0]
    if not differing:
        return Section("Q-tables")
    rows = [
        (
            f"{table.episode:,}",
            spoken(table.agent),
            f"{table.largest:.4g}",
            f"{table.mean:.4g}",
            f"{100 * table.greedy_share:.1f} %",
            UNKNOWN
            if math.isnan(table.greedy_share_visited)
            else f"{100 * table.greedy_share_visited:.1f} %",
        )
        for table in differing
    ]
    headings = ("episode", "agent", "largest", "mean", "other greedy action", "weighted by visits")
    last = differing[-1]
    heading = f"largest differences of {spoken(last.agent)} after {counted(last.episode, 'episode')}"
    cells = [(f"{cell.state}: {cell.action}", f"{cell.a:.6g}", f"{cell.b:.6g}") for cell in last.cells]
    return Section("Q-tables", grids=[Grid(headings, rows), Grid((heading, "A", "B"), cells)])


def _metrics(difference: RunDiff, everything: bool) -> Section:
    rows = [
        (
            metric.name,
            f"{metric.end_a:,.2f}",
            f"{metric.end_b:,.2f}",
            f"{metric.end_b - metric.end_a:+,.2f}",
            UNKNOWN if math.isnan(metric.area) else f"{metric.area:+,.2f}",
        )
        for metric in difference.metrics
        if everything or not metric.same
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
