"""The first step at which one setting changed what was learned, in two short runs recorded for it."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable
from pathlib import Path
from typing import Final

from runner.analysis.diff import can_compare_steps
from runner.analysis.diff.causes import find_cause
from runner.analysis.diff.divergence import training_divergence
from runner.analysis.diff.sections import where_in_words
from runner.analysis.diff.updates import replay_to
from runner.archive.places import opened
from runner.config import from_mapping
from runner.config.job import Job, identity_of
from runner.debugging.explanation import FirstStep
from runner.debugging.explanation_files import TAG
from runner.debugging.factors import Mixing
from runner.environments.naming import spoken
from runner.errors import RunnerError
from runner.execution.session import run_job
from runner.recording.labels import Labels
from runner.runs.catalogue.removal import plan, remove
from runner.runs.listing import list_runs
from runner.runs.run import UNLISTED, Run, new_run
from runner.util.processes import Stop

_EPISODES: Final = (100, 1000, 10_000)
"""Training episodes in which the step is looked for, one after the other."""


def first_step(
    mixing: Mixing,
    number: int,
    seed: int,
    recordings: Path,
    name: str,
    report: Callable[[int, int], None],
    stop: Stop,
) -> FirstStep:
    """Record A with and without one setting of B, until they differ; return where they do.

    If they do not, all settings of B with and without this one are recorded. The runs are not listed among
    those of the recordings folder: they are found by their ids, and have the name of the explanation as a
    tag. `report` is called a few times a second with the episodes recorded, and of how many; `stop` is called
    every few milliseconds, and returns True to stop.

    Raises:
        KeyboardInterrupt: `stop` returned True.
    """
    bit = 1 << number
    setting = mixing.factors[number].name
    folder = recordings / UNLISTED
    tag = TAG.format(name)
    made = {identity_of(run.file.config, run.seed): run for run in list_runs(folder) if tag in run.tags}
    pairs = [(0, bit, f"Changing {setting} alone in A")]
    if mixing.everything != bit:
        others = f"Changing {setting} when all other settings are as in B"
        pairs.append((mixing.everything - bit, mixing.everything, others))
    limit = min(mixing.a.episodes, mixing.b.episodes)
    for before, after, what in pairs:
        for episodes in sorted({min(limit, count) for count in _EPISODES}):
            runs = []
            for part, (mixture, word) in enumerate(((before, "without"), (after, "with"))):
                plain = {"episodes": episodes, "evaluation": None, "recording": {"console": False}}
                job = Job(from_mapping(mixing.config(mixture).to_mapping() | plain), seed)
                run = made.get(job.identity)
                if run is not None and run.status != "finished":
                    _discard(run)
                    run = None
                if run is None:
                    title = re.sub(r"[^A-Za-z0-9_.]+", "-", f"{word}-{setting}")[:100]
                    labels = Labels(tags=(tag,))
                    run = new_run(folder, job.config.to_mapping(), seed, title, labels=labels)
                    done = part * episodes
                    total = 2 * episodes
                    run = run_job(job, run, lambda now: report(done + now.episode, total), stop)  # noqa: B023
                    if run.status != "finished":
                        _discard(run)
                        raise KeyboardInterrupt("what was trained is kept")
                runs.append(run)
            difference = _difference(runs[0], runs[1], setting, what)
            if difference is not None:
                return difference
            for run in runs:
                _discard(run)
    sentence = (
        f"Neither alone nor last did {setting} change a step in {min(limit, _EPISODES[-1]):,} episodes."
    )
    return FirstStep(setting, "", "", None, None, None, (sentence,))


def _discard(run: Run) -> None:
    """Remove a run that shows nothing; one that a user keeps, or another process uses, stays."""
    with contextlib.suppress(RunnerError):
        remove(plan(run, run.folder.parent))


def _difference(before: Run, after: Run, setting: str, what: str) -> FirstStep | None:
    """Return where two runs differ first, and what is known of it; None if they do not differ."""
    with opened(before) as a, opened(after) as b:
        if not can_compare_steps(a, b):
            sentence = f"{what} changes the states or actions, so that no steps can be compared."
            return FirstStep(setting, a.run_id, b.run_id, None, None, None, (sentence,))
        divergence = training_divergence(a, b)
        sentences = []
        if divergence is not None and divergence.a_step is not None and divergence.b_step is not None:
            cause = find_cause(divergence, a, b)
            sentences.append(f"Training diverges {where_in_words(divergence)}: {cause.text}.")
            update = cause.update
            place = (divergence.step, divergence.episode, divergence.t)
        elif a.agents == b.agents:  # the first update that differs though all steps are the same
            steps = min(recording.train.steps.count() for recording in (a, b))
            update = replay_to(a, b, steps)[1]
        else:
            update = None
        if update is not None:
            record = next(a.train.steps.blocks(update.step, update.step + 1))[0]
            place = update.step, update.episode, int(record["t"])
            sentences.insert(
                0,
                f"{spoken(update.agent)}'s value of {update.action} in the state ({update.state}) became "
                f"{update.b:.6g} instead of {update.a:.6g}: {'; '.join(update.reasons)}.",
            )
        if not sentences:
            return None
    step, episode, t = place
    first = (
        f"{what} first changed an update at training step {step:,}, in episode {episode:,} at t = {t} "
        f"(runs {before.run_id} without it and {after.run_id} with it, which are recorded)."
    )
    return FirstStep(setting, before.run_id, after.run_id, step, episode, t, (first, *sentences))
