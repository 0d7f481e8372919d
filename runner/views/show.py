"""`show`: all about one run."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from runner.analysis.sections import Section
from runner.views.view import NO_PROGRESS, ReadyAnswer, ShownProgress, View

if TYPE_CHECKING:
    from runner.analysis.summary import RunDetails
    from runner.runs.run import Run


def show(run: Run, progress: ShownProgress = NO_PROGRESS) -> ReadyAnswer:
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

    folders = [] if run.stands_alone else [run.folder.parent]
    branches = look(folders, lambda index: index.branches(run.run_id), progress.say)
    details = replace(describe_run(run, progress.say), branches=branches)
    return ReadyAnswer(details.as_json(), _text(details, progress))


def _text(details: RunDetails, progress: ShownProgress) -> Iterator[Section]:
    from runner.analysis.summary import random_policy_sentence
    from runner.recording.reader import open_recording

    first, *others = details.sections()
    file = {"file": str(details.run.recording)} if details.bytes else {}
    yield replace(first, facts={**first.facts, **file})
    yield from others
    if details.evaluations:  # after all else: it may take seconds to compute
        with (
            progress.stage("evaluating a random policy"),
            open_recording(details.run.recording) as recording,
        ):
            sentence = random_policy_sentence(recording)
        if sentence:
            yield Section("Baseline", [sentence])


VIEW: Final = View("show", "Overview", show, subject="any run")
