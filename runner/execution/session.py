"""Run a job: the only place where learning meets recording.

A job may begin with the Q-tables of another run. A name may stand for another run tomorrow, and an
interrupted run may be resumed. So `initial_q` is resolved when the job is created: from then on the
configuration has the run's id and the step.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Final

import numpy as np

from runner.archive.places import opened
from runner.config import ExperimentConfig, from_mapping
from runner.config.model import Job
from runner.config.sections import RunTable
from runner.environments.loading import load_mdp
from runner.environments.mdp import Mdp
from runner.errors import Diverged, RunnerError, StorageError, truncated_message
from runner.learning.learner import Learner, NamedTables
from runner.planning.exact import ExactEvaluator
from runner.recording import schema
from runner.recording.layout import layout_of
from runner.recording.messages import Message, QTable, encode, encode_log, encode_q_table
from runner.recording.metadata import (
    Attachments,
    environment_attachments,
    run_metadata,
    write_description,
    write_result,
)
from runner.recording.metrics import METRICS, TABLE_METRICS, defined_metrics
from runner.recording.observer import Observer
from runner.recording.reader import Recording
from runner.recording.recorder import Recorder
from runner.recording.reference import Reference
from runner.recording.writer import RecordingFile, create_recording
from runner.replay.steps import last_step
from runner.replay.tables import named_tables_at, tables_before_training
from runner.runs import run as runs
from runner.runs.code import CodeCollector
from runner.runs.provenance import provenance_entries
from runner.runs.redaction import LineRedactor
from runner.runs.resolve import find_run
from runner.runs.run import Run
from runner.util.arrays import Records
from runner.util.processes import Stop
from runner.util.values import Json

REPORT_SECONDS: Final = 0.2
_OF_TABLES: Final = {metric.field: metric.of_table for metric in TABLE_METRICS}


@dataclass
class Progress:
    """The progress of a run, reported a few times a second."""

    episodes: int
    """Training episodes to do."""
    episode: int = 0
    train_steps: int = 0
    eval_steps: int = 0
    bytes_written: int = 0
    evaluations: list[Message] = field(default_factory=list)
    """The metrics of every evaluation so far; `optimality` has the exact ones, if they are computed."""
    log: list[str] = field(default_factory=list)
    """The log so far; of a resumed run, what its recording did not have before."""


Report = Callable[[Progress], None]


def run_job(
    job: Job,
    run: Run,
    report: Report = lambda _: None,
    stop: Stop = lambda: False,
    mdp: Mdp | None = None,
    threads: bool = True,
    initial: Sequence[NamedTables] | None = None,
) -> Run:
    """Train, evaluate and record a job; return its run, finished or interrupted.

    Args:
        stop: called every few milliseconds; when it returns True the recording is closed properly and the run
            is marked interrupted.
        threads: False records in the learning thread: quicker if it has one processor to itself.
        initial: the tables to begin with instead of those that the configuration names.
    """
    started = time.monotonic()
    code = CodeCollector(run.folder.parent, job.config.recording.code)
    with _failing(run):
        mdp = mdp or load_mdp(job.config.env.id, job.config.env.kwargs, job.config.rewards)
        if initial is None:
            job, run = resolve_job(job, run)
            initial = configured_tables(job.config, mdp, run.folder.parent, run.run_id)
        learner = Learner(job.config, mdp, job.seed, initial)
        file = create_recording(run.folder / runs.RECORDING_FILE)
    with file:
        with _failing(run):
            provenance = provenance_entries(with_command=job.config.recording.code)
            describe(file, job, run, learner, provenance)
            run = run.update(provenance=runs.made_by(provenance))
        beat = code.beat(run, file)
        recorder = recorder_for(job, learner, file, beat=beat, threads=threads)
        return execute(Session(job, learner, recorder, report, stop), file, run, started, code)


def execute(session: Session, file: RecordingFile, run: Run, started: float, code: CodeCollector) -> Run:
    """Run a session to its end, close its recording and return the run."""
    try:
        is_done, digests = session.finish()
        status = "finished" if is_done else "interrupted"
        summary = session.summary(digests)
        code.write(file, wait=True)
        write_result(file, status, summary)
    except BaseException as error:
        status = "interrupted" if isinstance(error, KeyboardInterrupt | Diverged) else "failed"
        with contextlib.suppress(StorageError):  # a full disk may still have space for the index
            code.write(file, wait=True)
            write_result(file, status, {"error": truncated_message(error)})
        with contextlib.suppress(StorageError):
            run.update(status=status, summary={"error": truncated_message(error), "bytes": file.size})
        _add_advice(run, error)
        raise
    summary |= {"seconds": round(time.monotonic() - started, 3), "bytes": file.size}
    return run.update(status=status, summary=summary, provenance=code.made_by(run))


@contextlib.contextmanager
def _failing(run: Run) -> Iterator[None]:
    """Mark the run as failed if the block raises an error."""
    try:
        yield
    except RunnerError as error:
        with contextlib.suppress(StorageError):
            run.update(status="failed", summary={"error": truncated_message(error)})
        _add_advice(run, error)
        raise


def _add_advice(run: Run, error: BaseException) -> None:
    """Add to the error of a full disk how to resume the run."""
    if isinstance(error, StorageError) and run.recording.exists():
        error.add_note(f"`dualtaxi resume {run.run_id}` continues it when there is space.")


class Session:
    """The execution of a job: alternates training and evaluation, and passes every block to the recorder."""

    def __init__(
        self,
        job: Job,
        learner: Learner,
        recorder: Recorder,
        report: Report = lambda _: None,
        stop: Stop = lambda: False,
    ) -> None:
        self._config = job.config
        self._learner = learner
        self.recorder = recorder
        self._report = report
        self._stop = stop
        self._progress = Progress(job.config.episodes)
        self._evaluated = 0
        self._last_report = 0.0

    def finish(self) -> tuple[bool, dict[str, str]]:
        """Run the whole job and end its recording, also after an error.

        Returns:
            Whether it was not stopped before its end, and the digest of each topic.
        """
        try:
            return self.run(), self.recorder.drain()
        except BaseException:
            self.recorder.abandon()
            raise

    def run(self) -> bool:
        """Run the whole job; return False if it was stopped before the end."""
        self._log(f"training {self._config.episodes} episodes with {self._config.algorithm}")
        for episode in self._boundaries():
            if not self._train(episode):
                break
            every = self._config.snapshots.every
            if episode in (0, self._config.episodes) or (every and episode % every == 0):
                self._snapshot()
            if not self._evaluate(episode):
                break
        else:
            self._log("finished")
            return True
        self._log("interrupted", "WARNING")
        return False

    def summary(self, topics: dict[str, str]) -> Json:
        """Return the summary of the run, for `run.json`."""
        last = self._progress.evaluations[-1] if self._progress.evaluations else None
        return self.recorder.totals(topics) | {
            "episodes": self._learner.episode,
            "steps_recorded": self._config.recording.steps == "all",
            "last_evaluation": last and evaluation_brief(last),
        }

    def _boundaries(self) -> Iterator[int]:
        """Yield the episodes at which training pauses for an evaluation or a snapshot, and the last one."""
        last = self._config.episodes
        evaluation = self._config.evaluation
        paces = [every for every in (evaluation and evaluation.every, self._config.snapshots.every) if every]
        episode = 0
        while episode < last:
            yield episode
            episode = min([last, *(episode - episode % every + every for every in paces)])
        yield last

    def _train(self, until_episode: int) -> bool:
        """Train up to an episode; return False if stopped."""
        recorder, learner = self.recorder, self._learner
        every = self._config.log.every_steps if self._config.log else 2**62
        while learner.episode < until_episode:
            if self._stop():
                return False
            next_log = (learner.step // every + 1) * every
            records, ends = recorder.block(schema.TRAIN_STEP), recorder.block(schema.TRAIN_EPISODE)
            steps, episodes = learner.train(records, ends, until_episode, next_log)
            recorder.commit("train", steps, episodes)
            if learner.step == next_log:
                self._measure(schema.TRAIN_METRICS_TOPIC, learner.training_metrics(_OF_TABLES))
            self._report_progress()
        return True

    def _evaluate(self, episode: int) -> bool:
        """Evaluate if it is due at this episode; return False if stopped."""
        plan = self._config.evaluation
        if plan is None or (episode % plan.every and episode != self._config.episodes):
            return True
        recorder, learner = self.recorder, self._learner
        learner.begin_evaluation()
        first = self._evaluated * plan.trials
        done = first
        trials = []
        while done < first + plan.trials:
            if self._stop():
                return False
            records = recorder.block(schema.EVAL_EPISODE)
            played = recorder.block(schema.EVAL_STEP)
            steps, ended = learner.evaluate(played, records, first + plan.trials)
            trials.append(records[:ended].copy())
            recorder.commit("eval", steps, ended)
            done += ended
            self._report_progress()
        metrics = evaluation_metrics(learner, self._evaluated, np.concatenate(trials))
        self._measure(schema.EVAL_METRICS_TOPIC, metrics)
        self._evaluated += 1
        self._progress.evaluations.append(metrics)
        if plan.exact:
            measured = self._exact_evaluator.measure(learner.policy, metrics["discount"])
            place = {name: metrics[name] for name in ("step", "episode", "evaluation")}
            self._measure(schema.OPTIMALITY_TOPIC, place | measured)
            self._progress.evaluations[-1] = metrics | {"optimality": measured}
        self._log(f"evaluation after {episode} episodes: {metrics['success_percent']:.1f} % success")
        return True

    def _measure(self, topic: schema.Topic, metrics: Message) -> None:
        self.recorder.message(topic, encode(topic.message, metrics))

    @cached_property
    def _exact_evaluator(self) -> ExactEvaluator:
        return ExactEvaluator(self._learner.mdp, len(self._learner.agents))

    def _snapshot(self) -> None:
        learner = self._learner
        for number, values in enumerate(learner.snapshot()):
            agent = learner.agents[number % len(learner.agents)]
            table = QTable(learner.step, learner.episode, agent, number, values)
            self.recorder.message(schema.Q_TABLE_TOPIC, encode_q_table(table))

    def _log(self, text: str, level: str = "INFO") -> None:
        steps = self.recorder.position
        message = encode_log(text, steps * schema.STEP_NANOSECONDS / 1e9, level)
        if self.recorder.message(schema.LOG_TOPIC, message):
            self._progress.log.append(text)
        self._report_progress(now=True)

    def _report_progress(self, now: bool = False) -> None:
        """Report the progress, at most once in `REPORT_SECONDS` unless `now`."""
        moment = time.monotonic()
        if not now and moment - self._last_report < REPORT_SECONDS:
            return
        self._last_report = moment
        progress = self._progress
        progress.episode, progress.train_steps, progress.eval_steps = self.done()
        progress.bytes_written = self.recorder.bytes_written
        self._report(progress)

    def done(self) -> tuple[int, ...]:
        """Return how many episodes, training steps and evaluation steps of the run are done."""
        return self._learner.episode, self.recorder.steps["train"], self.recorder.steps["eval"]


def evaluation_metrics(learner: Learner, evaluation: int, trials: Records) -> Message:
    """Return the metrics of an evaluation from its episode records, and of training at that moment."""
    has_success = bool(learner.mdp.success_events)
    successes = int(trials["success"].sum())
    return learner.training_metrics(_OF_TABLES) | {
        "evaluation": evaluation,
        "trials": len(trials),
        "successes": successes if has_success else -1,
        **{metric.field: math.nan for metric in METRICS},
        **{
            metric.field: np.asarray(metric.combine(metric.of_trials(trials))).tolist()
            for metric in defined_metrics(has_success, True)
        },
        "terminations": int(trials["terminated"].sum()),
        "events": trials["events"].sum(axis=0, dtype=np.int64).tolist(),
    }


def evaluation_brief(metrics: Message) -> Message:
    """Return the metrics of an evaluation for a summary, summed over the agents; unknown values are None."""
    values = {
        metric.name: sum(metrics[metric.field]) if metric.per_agent else metrics[metric.field]
        for metric in METRICS
    }
    return {
        "episode": metrics["episode"],
        **{name: value if math.isfinite(value) else None for name, value in values.items()},
    }


def recorder_for(
    job: Job,
    learner: Learner,
    file: RecordingFile | None,
    reference: Reference | None = None,
    beat: Callable[[], None] = lambda: None,
    threads: bool = True,
    clock: bool = True,
) -> Recorder:
    """Return a recorder for a learner's steps into a file, packed as in the job's configuration."""
    options = job.config.recording
    learners = len(learner.agents)
    events = len(learner.mdp.event_names)
    observer = None
    if clock and file is not None:
        console = LineRedactor() if options.console else None
        observer = Observer(file.path.parent, options.system, console)
    return Recorder(
        file,
        layout_of("job", learners, events),
        packing=options.packing,
        record_steps=options.steps == "all",
        reference=reference,
        beat=beat,
        threads=threads,
        observer=observer,
    )


def describe(
    file: RecordingFile, job: Job, run: Run, learner: Learner, made_by: Mapping[str, str] | None = None
) -> None:
    """Write the description that makes a recording self-contained.

    `made_by` is its provenance; this process's by default.
    """
    events = len(learner.mdp.event_names)
    facts = run_metadata(
        run.run_id, run.name, job.seed, job.identity, run.created_text, learner.agents, events
    )
    config = job.config.to_mapping()
    environment = _environment(learner.mdp)
    write_description(file, facts, config, made_by or provenance_entries(), environment)


@lru_cache(maxsize=4)
def _environment(mdp: Mdp) -> Attachments:
    return environment_attachments(mdp.description(), mdp.arrays())


def resolve_initial_q(config: ExperimentConfig, recordings: Path, exclude: str = "") -> ExperimentConfig:
    """Return a configuration whose `initial_q`, if it is a run's table, has the run's id and the step.

    Args:
        exclude: the id of the run that begins with the table, which is never meant.
    """
    start = config.initial_q
    if not isinstance(start, RunTable):
        return config
    source = find_run(start.run, recordings, exclude)
    step = start.step
    if step is None:
        with opened(source) as recording:
            step = last_step(recording)
    return from_mapping(
        config.to_mapping() | {"initial_q": {"run": address(source, recordings), "step": step}}
    )


def resolve_job(job: Job, run: Run) -> tuple[Job, Run]:
    """Return a job and its run with `initial_q` resolved, also in `run.json`."""
    config = resolve_initial_q(job.config, run.folder.parent, exclude=run.run_id)
    if config == job.config:
        return job, run
    return Job(config, job.seed), run.update(config=config.to_mapping())


def address(run: Run, recordings: Path) -> str:
    """Return how to find a run from a recordings folder: by its id, or by its path if it is elsewhere."""
    inside = run.folder.parent.resolve() == recordings.resolve()
    return run.run_id if inside and not run.stands_alone else str(run.recording.resolve())


def configured_tables(
    config: ExperimentConfig, mdp: Mdp, recordings: Path, exclude: str = ""
) -> list[NamedTables] | None:
    """Return what the learners of the run in `initial_q` have; None if the configuration has none.

    Args:
        exclude: the id of a run that is never meant.

    Raises:
        RunnerError: there is no such run or step, or its tables have another shape.
    """
    start = config.initial_q
    if not isinstance(start, RunTable):
        return None
    source = find_run(start.run, recordings, exclude=exclude)
    with opened(source) as recording:
        tables = named_tables_at(recording, last_step(recording) if start.step is None else start.step)
    joint = config.tables == "joint"
    shapes = [(mdp.states, n) for n in ([mdp.joint_actions] if joint else mdp.action_counts)]
    found = [table["q"].shape for table in tables]
    if found != shapes:
        raise RunnerError(f"initial_q: run {source.run_id} has tables of shape {found}, expected {shapes}.")
    return tables


def recorded_tables(recording: Recording) -> list[NamedTables] | None:
    """Return the tables that a run took from another run, from its own first snapshots.

    None if it took none, or was interrupted before them: then its configuration has their origin.
    """
    if not isinstance(from_mapping(recording.config).initial_q, RunTable):
        return None
    return tables_before_training(recording)
