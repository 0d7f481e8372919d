"""`dualtaxi label`, `mark`, `index`, `rm` and `prune`: label, index and remove runs."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from runner.analysis.sections import Grid
from runner.archive.places import archive_place
from runner.cli.command import Command, CommandGroup, argument, option
from runner.cli.options import (
    filter_argument,
    folders_option,
    runs_argument,
    tags_option,
)
from runner.cli.output import Remark, Reply, say
from runner.cli.parameter_types import INDEX
from runner.cli.runs import find, found_run, runs_folder
from runner.errors import ExitCode, RunnerError
from runner.runs.catalogue.columns import STATUSES, with_same_as
from runner.runs.run import Run, label
from runner.util.humanize import UNKNOWN, ago, counted, duration, number, size
from runner.util.values import Json

if TYPE_CHECKING:
    from runner.cli.output import Part
    from runner.runs.catalogue.index import CatalogueIndex
    from runner.runs.catalogue.removal import Removal


@click.command("label", cls=Command)
def label_command(
    run: Run = found_run,
    name: str | None = option(
        "--name", metavar="NAME", help="Rename the run; an empty NAME restores the original name."
    ),
    note: str | None = option(
        "--note", metavar="TEXT", help="Replace the note; - reads it from stdin, an empty one removes it."
    ),
    tags: tuple[str, ...] = tags_option,
    untags: tuple[str, ...] = option(
        "--untag", multiple=True, metavar="TAG", help="Remove a tag; may be repeated."
    ),
) -> Reply:
    """Change the name, note and tags of RUN, and show them.

    They are stored in labels.json next to the recording, which stays as it is. A run tagged `keep` is never
    removed by rm or prune. `dualtaxi ls '"TAG" in tags'` and `dualtaxi ls '"WORD" in note'` find labelled
    runs.

    Examples:
      dualtaxi label @latest --name patient --tag keep --tag figure-3
      dualtaxi label patient --note 'the step size of the paper'
      dualtaxi label k3v9m2xq --note - < observations.txt
      dualtaxi ls --quiet 'name == "quick"' | xargs -I{} dualtaxi label {} --tag first-try
    """
    missing = sorted(set(untags) - set(run.tags))
    labels = run.labels
    if name is not None or note is not None or tags or untags:
        labels = label(run, name, _from_stdin() if note == "-" else note, tags, untags)
    shown_name = labels.name or run.file.name
    values = {"run_id": run.run_id, "name": shown_name, "tags": list(labels.tags), "note": labels.note}
    tag_list = " ".join(labels.tags) or UNKNOWN
    rows = {"run": run.run_id, "name": shown_name, "tags": tag_list, "note": labels.note or UNKNOWN}
    notes = [f"Run {run.run_id} had no tag {', '.join(missing)}."] if missing else []
    return Reply(values, [rows], notes=notes)


@click.command("mark", cls=Command)
def mark_command(
    run: Run = found_run,
    at: str | None = argument(metavar="[STEP]", required=False),
    text: str = argument(metavar="[TEXT]", required=False, default=""),
    tags: tuple[str, ...] = tags_option,
    removed: tuple[str, ...] = option(
        "--unmark", multiple=True, metavar="MARK", help="Remove a mark by its id; may be repeated."
    ),
) -> Reply:
    """Mark a STEP of RUN with a TEXT, and list the marks of the run.

    A STEP is EPISODE:T, eval:N:TRIAL:T, step:N, or typical, best, worst or last. Marks are stored in
    marks.json next to the recording, which stays as it is. Pages, Rerun, `dualtaxi show` and the view `marks`
    of `dualtaxi sql` show them. `export mcap`, `import`, `archive`, `remote push` and `remote pull` take them
    along, and merge them with the marks that are there.

    Examples:
      dualtaxi mark k3v9m2xq 812:57 "both stuck" --tag stuck
      dualtaxi mark @latest worst --tag look-again
      dualtaxi mark k3v9m2xq --unmark 3f2a9c01b7de
    """
    from runner.analysis.episodes import mark, unmark

    if at is not None:
        mark(run, at, text, tags=tags)
    if removed:
        unmark(run, *removed)
    rows = [(mark.id, mark.at, mark.text, " ".join(mark.tags)) for mark in run.marks]
    headings = ("mark", "step", "text", "tags")
    grid = Grid(headings, rows, left=headings)
    values = {"run_id": run.run_id, "marks": [mark.as_row() for mark in run.marks]}
    return Reply(values, [grid if rows else f"Run {run.run_id} has no marks."])


def _from_stdin() -> str:
    try:
        return sys.stdin.read()
    except UnicodeDecodeError as error:
        raise RunnerError(f"stdin: found bytes that are not UTF-8 ({error}), expected text.") from error


@click.group("index", cls=CommandGroup)
def index_command() -> None:
    """Manage the index of runs, which makes listing them quick.

    Example:
      dualtaxi index rebuild
    """


@index_command.command("rebuild")
def rebuild(recordings: tuple[Path, ...] = folders_option) -> Reply:
    """Rebuild the index from the runs in the recordings folder.

    This is never required: commands notice changes by themselves, and the index holds nothing of its own.
    Exit code 1 if there are folders with files of a run that cannot be read.

    Examples:
      dualtaxi index rebuild
      dualtaxi index rebuild --recordings others --recordings recordings
    """
    from runner.runs.catalogue.database import index_path
    from runner.runs.catalogue.index import look

    began = time.monotonic()
    statuses, copies, problems = look(recordings, _contents, say, rebuild=True)
    took, runs = time.monotonic() - began, statuses.total()
    counts = dict(sorted(statuses.items()))
    values = {
        "runs": runs,
        "same_content": copies,
        "statuses": counts,
        "problems": problems,
        "seconds": round(took, 3),
        "index": str(index_path()),
    }
    listed = ", ".join(f"{count:,} {status}" for status, count in counts.items())
    rows = {
        "runs": f"{runs:,}" + (f": {listed}" if listed else ""),
        "same": f"{copies:,} of them recorded the same content as an earlier run" if copies else "",
        "took": duration(took),
        "index": str(index_path()),
    }
    code = ExitCode.DIFFERENT if problems else ExitCode.OK
    return Reply(values, [rows, *map(Remark, problems)], exit_code=code)


def _contents(index: CatalogueIndex) -> tuple[Counter[str], int, list[str]]:
    """Return the number of runs of each status, the number of copies, and the problems of folders."""
    from runner.runs.catalogue.filters import Filter

    rows = index.rows(Filter(None), columns=("root", "entry", "status", "digest"))
    statuses: Counter[str] = Counter()
    copies = 0
    for row in with_same_as(rows, index.originals()):
        statuses[row["status"]] += 1
        copies += row["same_as"] is not None
    return statuses, copies, index.problems()


_yes_option = option("--yes", "-y", is_flag=True, help="Do not ask for confirmation.")
_foreign_option = option(
    "--foreign-files",
    is_flag=True,
    help="Also remove files and folders in a run's folder that no run writes.",
)
_dry_run_option = option(
    "--dry-run", is_flag=True, help="Show what would be removed and how much is freed, and remove nothing."
)


@click.command("rm", cls=Command)
def rm_command(
    run_names: tuple[str, ...] = runs_argument,
    folder: Path = runs_folder,
    yes: bool = _yes_option,
    dry_run: bool = _dry_run_option,
    foreign: bool = _foreign_option,
) -> Iterator[Reply]:
    """Remove runs and their recordings, after confirmation.

    If a run is running or tagged `keep`, or its folder holds files that no run writes, nothing is removed.
    Links are not followed. Archives stay.

    Examples:
      dualtaxi rm k3v9m2xq p7
      dualtaxi rm @latest --dry-run
      dualtaxi ls --quiet 'status == "failed"' | xargs dualtaxi rm --yes
    """
    from runner.runs.catalogue.removal import plan

    runs = {run.folder.resolve(): run for run in (find(name, folder) for name in run_names)}
    removals = [plan(run, folder, foreign) for run in runs.values()]
    refused = [f"run {removal.run_id} stays: {removal.refusal}." for removal in removals if removal.refusal]
    if refused:
        raise RunnerError("\n".join([*refused, "Nothing was removed."]))
    yield from _carry_out(removals, {}, foreign, yes, dry_run)


@click.command("prune", cls=Command)
def prune_command(
    words: tuple[str, ...] = filter_argument,
    recordings: tuple[Path, ...] = folders_option,
    older_than: str | None = option(
        "--older-than", metavar="AGE", help="Runs that started longer ago than this: 30d, 12h, 2w."
    ),
    keep_last: int | None = option(
        "--keep-last", type=INDEX, help="Keep the newest N runs of each configuration."
    ),
    statuses: tuple[str, ...] = option(
        "--status",
        multiple=True,
        type=click.Choice([status for status in STATUSES if status != "running"]),
        help="Runs with this status; may be repeated. Archived runs are removed only with --status archived.",
    ),
    explanations: bool = option(
        "--explanations",
        is_flag=True,
        help="Instead of runs: what `dualtaxi explain` trained, and its results.",
    ),
    dry_run: bool = _dry_run_option,
    yes: bool = _yes_option,
    foreign: bool = _foreign_option,
) -> Iterator[Reply]:
    """Remove the runs that match FILTER (as in `dualtaxi ls`) and all options, after confirmation.

    At least one of them must be given. --keep-last keeps the newest runs of each configuration name, counted
    over all runs. Runs that are running or tagged `keep` stay, and so do those whose folder holds files that
    no run writes.

    Examples:
      dualtaxi prune --older-than 30d --keep-last 5 --status interrupted --dry-run
      dualtaxi prune 'config == "quick" and success_percent < 50' --yes
      dualtaxi prune --explanations --dry-run
    """
    from runner.runs.catalogue.filters import parse, seconds_of
    from runner.runs.catalogue.index import look
    from runner.runs.catalogue.removal import Criteria, plan_row, unwanted

    if explanations:
        if words or older_than is not None or keep_last is not None or statuses or foreign:
            raise click.UsageError("--explanations removes all of them: leave out FILTER and other criteria.")
        yield from _prune_explanations(recordings, dry_run, yes)
        return
    try:
        seconds = None if older_than is None else seconds_of(older_than)
    except ValueError:
        raise RunnerError(
            f"--older-than: found {older_than!r}, expected an age such as 30d, 12h or 2w."
        ) from None
    criteria = Criteria(parse(" ".join(words)), seconds, keep_last, statuses)
    if criteria.filter.condition is None and older_than is None and keep_last is None and not statuses:
        raise click.UsageError("expected a FILTER, --older-than, --keep-last or --status: which runs?")
    rows, protected = look(recordings, lambda index: unwanted(index, criteria, time.time()), say)
    removals = [plan_row(row, foreign) for row in rows]
    refusals = {removal.run_id: removal.refusal for removal in removals if removal.refusal}
    for run_id, reason in refusals.items():
        say(f"Run {run_id} stays: {reason}.")
    if protected:
        counts = ", ".join(f"{count:,} {reason}" for reason, count in sorted(protected.items()))
        say(f"Left alone: {counts}.")
    removals = [removal for removal in removals if not removal.refusal]
    yield from _carry_out(removals, refusals, foreign, yes, dry_run)


def _prune_explanations(recordings: Sequence[Path], dry_run: bool, yes: bool) -> Iterator[Reply]:
    """Show what explanations trained, ask, and remove it."""
    from runner.debugging.explanation import remove_trained, trained_in

    explanations = [explanation for folder in recordings for explanation in trained_in(folder)]
    rows = [{"name": explanation.name, "bytes": explanation.bytes} for explanation in explanations]
    freed = sum(explanation.bytes for explanation in explanations)
    what = counted(len(explanations), "explanation")
    if explanations:
        cells = [
            (explanation.name, f"{len(explanation.runs):,}", size(explanation.bytes))
            for explanation in explanations
        ]
        stay = [run for explanation in explanations for run in explanation.runs if run.refusal]
        notices = [Remark(f"Run {run.run_id} stays: {run.refusal}.") for run in stay]
        grid = Grid(("explanation", "runs", "frees"), cells, left=("explanation",))
        yield Reply(text=[grid, *notices])
        if not dry_run:
            _confirm(f"Remove {what} for good, and free {size(freed)}?", yes)
            for explanation in explanations:
                remove_trained(explanation)
    yield _removed(what if explanations else "", {"dry_run": dry_run, "freed": freed, "removed": rows})


def _removed(what: str, result: Json) -> Reply:
    """Return what was removed, or would be; `what` is empty if that is nothing."""
    text = f"Removed {what}, freed {size(result['freed'])}."
    if not what:
        text = Remark("There is nothing to remove.")
    elif result["dry_run"]:
        text = Remark(f"Nothing was removed; it would free {size(result['freed'])}.")
    return Reply(result, [text])


def _confirm(question: str, yes: bool) -> None:
    """Ask before something is removed."""
    if not yes and not sys.stdin.isatty():
        raise RunnerError("there is no terminal to ask on; --yes removes without asking, --dry-run shows.")
    if not yes:
        click.confirm(question, abort=True, err=True)


def _carry_out(
    removals: Sequence[Removal], kept: dict[str, str], foreign: bool, yes: bool, dry_run: bool
) -> Iterator[Reply]:
    """Show the removals, ask, carry them out and say what was freed.

    None of the removals is refused; `kept` has the reason for each run that stays, by id, for programs.

    Raises:
        RunnerError: some runs could not be removed, as they were tagged meanwhile; all others are gone.
    """
    from runner.runs.catalogue.removal import clean, contents_freed, remove

    contents, failures = contents_freed(removals), dict[str, str]()
    freed = sum(removal.freed for removal in removals) + contents
    if removals:
        yield Reply(text=_preview(removals, contents))
    if removals and not dry_run:
        runs = "this run" if len(removals) == 1 else f"these {len(removals):,} runs"
        _confirm(f"Remove {runs} for good, and free {size(freed)}?", yes)
        for removal in removals:
            try:
                remove(removal, foreign)
            except RunnerError as error:
                failures[removal.run_id] = str(error)
        staying = [removal for removal in removals if removal.run_id in failures]
        removals = [removal for removal in removals if removal.run_id not in failures]
        contents -= contents_freed(staying)
        freed = sum(removal.freed for removal in removals) + contents
        for root in {removal.root for removal in removals}:
            clean(root, {removal.run_id for removal in removals})
    removed = [
        {
            "run_id": removal.run_id,
            "name": removal.name,
            "status": removal.status,
            "path": str(removal.folder.absolute()),
            "bytes": removal.freed,
        }
        for removal in removals
    ]
    reasons = [{"run_id": run_id, "why": reason} for run_id, reason in (kept | failures).items()]
    result = {
        "dry_run": dry_run,
        "freed": freed,
        "checkpoints": contents,
        "removed": removed,
        "kept": reasons,
    }
    reply = _removed(counted(len(removals), "run") if removals else "", result)
    yield Reply(result) if failures and not removals else reply
    if failures:
        raise RunnerError("\n".join(failures.values()))


def _preview(removals: Sequence[Removal], contents: int) -> Iterator[Part]:
    """Yield the table of the removals, and what else is removed or stays."""
    rows = [
        (
            removal.run_id,
            removal.name,
            UNKNOWN if removal.seed is None else str(removal.seed),
            removal.status,
            UNKNOWN if removal.success_percent is None else number(removal.success_percent),
            ago(removal.created),
            size(removal.freed),
        )
        for removal in removals
    ]
    headings = ("id", "name", "seed", "status", "success %", "age", "frees")
    yield Grid(headings, rows, left=("id", "name", "status"), cut=("name",))
    yield from (Remark(_archive_notice(removal.run())) for removal in removals if removal.is_archived)
    if contents:
        yield Remark(f"Checkpoints that no other run refers to go too: {size(contents)}.")


def _archive_notice(run: Run) -> str:
    """Return what is left of a run in its archive; object storage is not queried, which may take minutes."""
    target = run.archive.target
    if "://" in target:
        return f"The archive of {run.run_id} at {target} is left alone."
    try:
        place = archive_place(run)
    except RunnerError as error:
        return f"Run {run.run_id} may still be in its archive, which cannot be read: {error}"
    if place is None:
        return f"Run {run.run_id} was archived at {target}, but is not there: nothing of it will be left."
    return f"The archive of {run.run_id} at {place} stays."
