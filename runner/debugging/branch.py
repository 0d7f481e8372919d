"""`runner.branch`: take another action at a recorded step, or other settings, and see where that leads.

    branch = runner.branch(run, at="12:40", action=1, policy="random")
    print(branch.parent.returns, branch.outcome.returns, branch.run.run_id)

The environment of a loop is made again, and brought to the step by the recorded reset and actions, which also
brings its random generators there. The branch is a run of one episode, equal to its parent's before the step.
"""

from __future__ import annotations

import copy
import json
import os
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

from runner.analysis.episodes import STEP, EpisodeRef, StepLike
from runner.environments.interfaces import is_game
from runner.errors import CannotRedo, ConfigError, RunnerError
from runner.execution.branching import TrainingBranch, branch_training
from runner.loops.actions import Names, action_in_words, action_names, parsed_action
from runner.loops.env import record_alone
from runner.loops.policies import Policy, from_policy, policy_named
from runner.recording.reader import Recording, open_recording
from runner.recording.spaces import Value
from runner.replay.engine import BLOCK_SECONDS, Rerun
from runner.replay.environment import episode_at
from runner.replay.makers import stream_from_child, why_not_rerun
from runner.replay.steppers import Stepper
from runner.replay.steps import transitions_of
from runner.replay.trust import trusting
from runner.runs.branches import BranchOrigin
from runner.runs.run import Run, recordings_folder, run_at
from runner.runs.trust_marks import marking_nothing
from runner.util.files import storage_errors
from runner.util.humanize import counted, number
from runner.util.jsonable import as_json
from runner.util.processes import Report, Stop, report_progress
from runner.util.values import checked_run_name

POLICIES: Final = ("recorded", "random", "constant")
RAN_OUT: Final = "the recorded actions ran out"
MAX_STEPS: Final = 100_000
"""The most steps that a branch takes unless chosen otherwise."""


@dataclass(frozen=True)
class BranchOutcome:
    """Where an episode led."""

    returns: dict[str, float]
    """The sum of the rewards of each agent."""
    length: int
    end: str
    """`terminated` or `truncated`; else why the episode was not played to its end."""

    @property
    def returns_in_words(self) -> str:
        """The return, of several agents each with its name."""
        several = len(self.returns) > 1
        return ", ".join(
            f"{agent} {number(value)}" if several else number(value) for agent, value in self.returns.items()
        )

    def __str__(self) -> str:
        """Return a sentence without its end: `return 12 in 40 steps, terminated`."""
        return f"return {self.returns_in_words} in {counted(self.length, 'step')}, {self.end}"


@dataclass(frozen=True)
class Branch:
    """A branch of an episode."""

    run: Run
    """The run that it was recorded in."""
    origin: BranchOrigin
    parent: BranchOutcome
    outcome: BranchOutcome
    is_recorded_action: bool
    """Whether the action of the step is the one that was recorded there."""


@dataclass(frozen=True)
class EpisodeBranch:
    """How an episode of a loop is branched; the arguments of `branch`."""

    at: EpisodeRef
    action: Value
    policy: str
    seed: int
    name: str | None
    max_steps: int = MAX_STEPS
    trust: bool = False
    run_id: str | None = None
    """The id of the new run, from `new_run_id`."""
    user_folder: Path = field(default_factory=Path.cwd)
    """Where the module of a policy is looked for."""


def branch(
    run: Run,
    *,
    at: StepLike,
    action: Any = None,
    overrides: Sequence[str] = (),
    episodes: int | None = None,
    policy: str = "recorded",
    seed: int = 0,
    name: str | None = None,
    recordings: str | os.PathLike[str] | None = None,
    max_steps: int = MAX_STEPS,
    trust: bool = False,
    report: Report = lambda _: None,
    stop: Stop = lambda: False,
) -> Branch | TrainingBranch:
    """Change one step of a recorded run, and record what follows as a run of its own, with the same draws.

    The training of a job is changed at `at`, and goes on to its end: see
    `runner.execution.branching.branch_training`. For a loop, one episode is played on, in its environment
    alone where it is one of a vector: in a child process with limits on memory and time, where it is compared
    with the recording on the way to the step. What fails leaves no run. `runner.what_if` plays actions of a
    job on without training.

    Args:
        run: the parent.
        at: the step: `EPISODE:T`; of a job also its number or `step:N`; of a loop also `eval:N:TRIAL:T`.
        action: the action there; None for the recorded one. For a loop as the environment takes it, or as
            text: a number or a name, numbers separated by commas, JSON for `Dict` and `Tuple`; of a game a
            mapping by agent, or `AGENT=VALUE`, where the other agents act as recorded.
        overrides: for a job, `KEY=VALUE` each: the settings from this step on.
        episodes: for a job, the training episodes in all; the parent's by default.
        policy: for a loop, what acts after the step: `recorded`, the rest of the recorded actions, and where
            they run out before the end the branch stops; `random`; `constant`, the action of the step; or
            `module:function`, which takes an observation and returns an action (of a game both by agent).
        seed: of the policy `random`.
        name: of the new run; `NAME.branch` by default.
        recordings: the folder of the new run: $DUALTAXI_RECORDINGS, or ./recordings, by default.
        max_steps: for a loop, the most steps to take from the step on.
        trust: whether to import what the recording of a loop names to make its environment again.
        report: called with the number of steps taken so far.
        stop: called every few milliseconds of training; return True to stop.

    Returns:
        Its `run`, and the `origin` of the branch; of a loop also where parent and branch led.

    Raises:
        ConfigError: an argument does not fit the run, or the action is not in the environment's space.
        CannotRedo: the environment of a loop cannot be made again, differs from the recording, or fails.
        RecordingError: there is no such episode or step, or the recording is damaged.
        RunnerError: see `branch_training`.
        StorageError: the folder of the new run cannot be written.
    """
    at = EpisodeRef.parse(at)
    if branches_training(run, at, overrides, episodes, policy, seed, max_steps):
        return branch_training(
            run,
            at=at,
            action=action,
            overrides=overrides,
            episodes=episodes,
            name=name,
            recordings=recordings,
            report=lambda progress: report(progress.train_steps),
            stop=stop,
        )
    task = EpisodeBranch(at, action, policy, seed, name, max_steps, trust)
    return branch_episode(run, task, recordings_folder(recordings), report)


def branches_training(
    run: Run,
    at: EpisodeRef,
    overrides: Sequence[str],
    episodes: int | None,
    policy: str,
    seed: int,
    max_steps: int,
) -> bool:
    """Return whether a branch of the run is trained, as the run was; else an episode of it is branched.

    Raises:
        ConfigError: an argument of `branch` does not fit that.
    """
    if run.can_train_again:
        if (policy, seed, max_steps) != ("recorded", 0, MAX_STEPS):
            raise ConfigError(
                f"run {run.run_id} was trained here, and a branch of it is trained as its "
                "configuration says: policy, seed and max_steps are for loops."
            )
        return True
    if at.word == STEP:
        raise ConfigError(
            f"at: found the number {at.t:,} of a step, expected EPISODE:T: the steps of a loop are "
            "counted in its episodes."
        )
    if overrides or episodes is not None:
        raise ConfigError(
            f"run {run.run_id} is a loop, of which an episode is branched; overrides and episodes are for "
            "runs that were trained here."
        )
    if policy not in POLICIES and ":" not in policy:
        raise ConfigError(
            f"policy: found {policy!r}, expected {', '.join(POLICIES)}, or module:function of your own"
        )
    if seed < 0:
        raise ConfigError(f"seed: found {seed}, expected 0 or more")
    if max_steps < 1:
        raise ConfigError(f"max_steps: found {max_steps}, expected 1 or more")
    return False


def branch_episode(run: Run, task: EpisodeBranch, recordings: Path, report: Report) -> Branch:
    """Play an episode of a loop on from a step, and record that as a run in a folder: see `branch`.

    Raises:
        ConfigError, CannotRedo, RecordingError, StorageError: as `branch`.
    """
    checked_run_name(task.name)
    with storage_errors(recordings):
        recordings.mkdir(parents=True, exist_ok=True)
        # Runs in hidden folders are not listed.
        staging = tempfile.TemporaryDirectory(prefix=".branch-", dir=recordings)
    with staging as name:
        staged = Path(name).absolute()
        for message in stream_from_child(_record_branch, run.recording.absolute(), staged, task):
            if isinstance(message, int):
                report(message)
            else:
                run_id, origin, stopped, is_recorded = message
        with storage_errors(recordings / run_id):
            (staged / run_id).rename(recordings / run_id)
    branch_run = run_at(recordings / run_id)
    with open_recording(run.recording) as recording:
        before = _outcome(recording, origin.phase, origin.episode, "unfinished")
    with open_recording(branch_run.recording) as recording:
        return Branch(branch_run, origin, before, _outcome(recording, origin.phase, 0, stopped), is_recorded)


def default_name(recording: Recording) -> str:
    """Return the name of a branch of an episode that is not given one."""
    return f"{recording.name[:90]}.branch"


def _outcome(recording: Recording, phase: str, episode: int, otherwise: str) -> BranchOutcome:
    """Return where an episode led; `otherwise` is its end if it has none."""
    returns = [0.0] * len(recording.agents)
    length = 0
    end = otherwise
    for step in transitions_of(recording, phase, episode):
        length += 1
        returns = [sum(pair) for pair in zip(returns, map(float, step["rewards"]), strict=True)]
        end = "terminated" if step["terminated"] else "truncated" if step["truncated"] else otherwise
    return BranchOutcome(dict(zip(recording.agents, returns, strict=True)), length, end)


# --- in the child process -----------------------------------------------------------------------------


def _record_branch(path: Path, folder: Path, task: EpisodeBranch) -> None:
    """Record a branch; report the steps taken, then what `branch` returns."""
    os.chdir(task.user_folder)
    with open_recording(path) as recording:
        if reason := why_not_rerun(recording, task.trust):
            raise CannotRedo(reason)
        player = _Player(recording, folder, task)
        make = partial(Rerun, recording, task.trust, 0.0, report_progress, False)
        with episode_at(recording, player.phase, player.episode, task.at.t, make, player.begin):
            stopped = player.play()
    report_progress((player.rec.run.run_id, player.origin, stopped, player.is_recorded_action))


class _Player:
    """Records an episode from its reset on, and plays on from a step."""

    rec: Any
    """The recorded environment."""
    origin: BranchOrigin
    is_recorded_action: bool

    def __init__(self, recording: Recording, folder: Path, task: EpisodeBranch) -> None:
        self._recording = recording
        self._folder = folder
        self._task = task
        self._at = task.at.resolved(recording)
        self.phase, self.episode = self._at.phase, self._at.number_in(recording)
        self._function: Policy | None = policy_named(task.policy) if ":" in task.policy else None
        self._actions: Iterator[Value] = iter(())

    def begin(self, stepper: Stepper, actions: Iterator[Value]) -> None:
        """Record the environment from now on."""
        env, task, recording = stepper.env, self._task, self._recording
        maker = recording.phase(self.phase).maker_of()
        assert maker is not None  # or `why_not_rerun` gave a reason
        self._stepper = stepper
        self._actions = actions
        self._space = copy.deepcopy(stepper.action_space)
        self._space.seed(task.seed)
        names: Names = {agent: recording.phase(self.phase).action_names(agent) for agent in recording.agents}
        if not is_game(env):
            names = recording.phase(self.phase).action_names() or action_names(env, self._space)
        recorded = next(actions)
        self._action = parsed_action(self._space, task.action, recorded, names)
        self.is_recorded_action = _text(self._action) == _text(recorded)
        self.origin = BranchOrigin(
            recording.run_id,
            self.phase,
            self.episode,
            self._at.t,
            str(self._at),
            _text(self._action),
            task.policy,
            task.seed,
            action_in_words(self._space, self._action, names),
        )
        settings = recording.config.get("config")
        with trusting(recording.path, maker, task.trust) as is_trusted, marking_nothing(not is_trusted):
            stepper.env = record_alone(
                env,
                self._folder,
                name=task.name or default_name(recording),
                seed=recording.seed,
                config={**(settings if isinstance(settings, Mapping) else {}), "origin": self.origin},
                make=maker.make if is_trusted and maker.make else None,
                run_id=task.run_id,
            )
            self.rec = stepper.env
        self.rec._enter(self.phase)

    def play(self) -> str:
        """Take the action, and play on; return why that stopped before the end, empty if it did not."""
        task = self._task
        action = self._action
        reported = time.monotonic()
        for count in range(1, task.max_steps + 1):
            try:
                observation, _, terminated, truncated, _ = self.rec.step(action)
            except (MemoryError, RunnerError):
                raise
            except Exception as error:  # foreign code raises anything
                raise CannotRedo(
                    f"The environment failed at t {task.at.t + count - 1:,} of the branch, with the action "
                    f"{_text(action)}: {type(error).__name__}: {error}"
                ) from error
            if self.rec.is_over(terminated, truncated):
                return ""
            action = self._next(observation)
            if action is None:
                return RAN_OUT
            if time.monotonic() - reported > BLOCK_SECONDS:
                reported = time.monotonic()
                report_progress(task.at.t + count)
        return f"stopped after {task.max_steps:,} steps"

    def _next(self, observation: object) -> Value:
        """Return the policy's action; None where the recorded ones run out."""
        if self._function is not None:
            with from_policy(self._task.policy):
                return self._function(observation)
        if self._task.policy == "recorded":
            action = next(self._actions, None)
        else:
            action = self._space.sample() if self._task.policy == "random" else self._action
        return None if action is None else self._stepper.applicable(action)


def _text(action: object) -> str:
    return json.dumps(as_json(action))
