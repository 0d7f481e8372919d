"""Whether a recording is what its job gives: every byte, every step, every figure, every table.

A job fixes its content, so the strongest check is also the simplest one: do the job again, in memory,
and compare. By the environment data in the recording this says whether the recording is true to itself
(each step among the outcomes, each draw as the seed gives it, each metric, episode and table as the
steps make them); by the installed environment, whether the run can be reproduced here and now.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runner.config import from_mapping
from runner.errors import Diverged, RecordingError
from runner.execution import Session, recorder_for
from runner.job import Job
from runner.learning.learner import Learner
from runner.mdp import Mdp, load_mdp
from runner.provenance import provenance
from runner.recording.digest import combine
from runner.recording.integrity import check_integrity
from runner.recording.past import Past
from runner.recording.reader import Recording, open_recording


@dataclass(frozen=True)
class Verification:
    """What a verification found."""

    path: Path
    finding: str = ""
    """The first thing that is wrong; empty if nothing is."""
    difference: Diverged | None = None
    """The same by its parts, if a message differs."""
    train_steps: int = 0
    eval_steps: int = 0
    content_digest: str = ""
    notes: tuple[str, ...] = field(default=())
    """What a reader should know though it is not wrong."""
    provenance: dict[str, tuple[str, str]] = field(default_factory=dict)
    """Where this process and the recording's differ: key to (recording, here)."""

    @property
    def sound(self) -> bool:
        """Whether nothing is wrong."""
        return not self.finding


def verify(path: Path, rerun: bool = False) -> Verification:
    """Verify a recording.

    Args:
        path: the recording.
        rerun: compare with the installed environment's job instead of the recorded environment's.
    """
    try:
        check_integrity(path)
        with open_recording(path) as recording:
            return _compare(recording, rerun)
    except RecordingError as error:
        return Verification(path, finding=str(error))


def _compare(recording: Recording, rerun: bool) -> Verification:
    config = from_mapping(recording.config)
    job = Job(config, int(recording.run["seed"]))
    mdp = load_mdp(config.env.id, config.env.kwargs, config.rewards) if rerun else recording.mdp
    complete = recording.result.get("status") == "finished"
    past = Past(recording, complete, without_steps=config.recording.steps == "none")
    session = rerun_session(job, mdp, recording, past)
    facts: dict[str, Any] = {
        "provenance": differing_provenance(recording) if rerun else {},
        "notes": () if complete else ("the run was interrupted; verified as far as it got",),
    }
    try:
        session.run()
        topics = session.recorder.drain()
        if complete:
            past.check_over()
    except Diverged as error:
        session.recorder.abandon()
        return Verification(recording.path, str(error), error, **facts)
    steps = session.recorder.steps
    facts |= {"train_steps": steps["train"], "eval_steps": steps["eval"]}
    if not complete:
        return Verification(recording.path, **facts)
    found, expected = recording.result.get("content_digest"), combine(topics)
    finding = "" if found == expected else f"content digest: found {found}, expected {expected}"
    return Verification(recording.path, finding, content_digest=expected, **facts)


def rerun_session(job: Job, mdp: Mdp, recording: Recording, past: Past) -> Session:
    """Return a session that does a recorded job again, in memory, against its past."""
    learner = Learner(job.config, mdp, job.seed, initial_tables(recording))
    recorder = recorder_for(job, learner, None, past)
    return Session(job, learner, recorder, stop=lambda: past.exhausted and not past.complete)


def initial_tables(recording: Recording) -> list[NDArray[np.float64]] | None:
    """Return the tables that a run began with, from its first snapshots; None if it was cut off before."""
    tables: list[NDArray[np.float64]] = []
    for snapshot in recording.snapshots():
        if snapshot.step or snapshot.table != len(tables):
            break
        tables.append(snapshot.values)
    return tables if len(tables) == int(recording.run["learners"]) else None


def differing_provenance(recording: Recording) -> dict[str, tuple[str, str]]:
    """Return where the recording was made by something else than this process: key to (recording, here)."""
    here = provenance()
    return {
        key: (recording.provenance.get(key, ""), here.get(key, ""))
        for key in sorted({*recording.provenance, *here})
        if recording.provenance.get(key) != here.get(key)
    }
