"""RLlib: `config.callbacks(runner.integrations.rllib.Recording(name="ppo"))`, for its present API stack.

The algorithm's process begins the run. Each env runner, also one that evaluates, records its environments as
a shard of that run; they are put together when the algorithm is stopped.
"""

from __future__ import annotations

import copy
import inspect
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any, Final, Unpack

import numpy as np

from runner.environments.interfaces import MultiAgent
from runner.errors import EnvironmentNotUsable, RunnerError, truncated_message
from runner.integrations.libraries import OF_THE_RUN, Callback, as_setting, require_tested
from runner.integrations.shapes import as_run_name
from runner.loops.description import Described
from runner.loops.env import described_game, record_parallel
from runner.loops.loop import Loop
from runner.loops.makers import game_maker_of, vector_maker_of
from runner.loops.options import CallbackOptions, options_of
from runner.loops.recorded import Recorded
from runner.loops.values import warn_user
from runner.loops.vector import (
    autoreset_mode_of,
    described_vector,
    first_of,
    record_vector,
)
from runner.recording.maker import EnvironmentMaker
from runner.util.values import Json, flatten

require_tested("ray", "rllib", ("2.60", "2.60"))

from ray.rllib.algorithms.algorithm import Algorithm  # noqa: E402
from ray.rllib.callbacks.callbacks import RLlibCallback  # noqa: E402
from ray.rllib.env.vector.vector_multi_agent_env import VectorMultiAgentEnv  # noqa: E402
from ray.tune.registry import ENV_CREATOR, _global_registry  # noqa: E402

_RESULTS: Final = ("training_iteration", "env_runners", "learners", "evaluation")
"""What is logged of an iteration's result, in this order: plots and pages show the first names."""
_CLOCK: Final = re.compile(r"(^|/)(timers|sample|[^/]*(_timer|throughput|_sec_|_between_)[^/]*)(/|$)")
"""What is not logged, because it differs between two runs that are otherwise the same."""
_STEPS: Final = "num_env_steps_sampled_lifetime"


class Recording(Callback, RLlibCallback):  # type: ignore[misc]
    """Records what the env runners of an algorithm do, and the results of its iterations.

        config = PPOConfig().environment("CartPole-v1").callbacks(runner.integrations.rllib.Recording())

    Each algorithm that is built from the configuration is a run, which ends with `algorithm.stop()`. In Ray
    Tune each trial is a run, and has its name.

    Args:
        recordings: the recordings folder, which all nodes share; by default $DUALTAXI_RECORDINGS or
            ./recordings.
        checkpoint_every: keep the weights as the checkpoint `module` after this many iterations, and at the
            end; 0 for none.
        options: the others of `runner.record`, except `join` and `shard`; and `frames_of`, as for
            `runner.record_vector`, unless environments have several agents. The run has the name of
            algorithm and environment, or of the trial of Ray Tune, and the configuration's seed unless
            given, and the configuration with the settings of `config`. `make` makes one of the environments.

    Raises:
        ConfigError: an argument cannot be used.
    """

    _run: _Run | None = None
    _iterations = 0

    def __init__(
        self,
        recordings: str | os.PathLike[str] | None = None,
        *,
        checkpoint_every: int = 0,
        **options: Unpack[CallbackOptions],
    ) -> None:
        if recordings is not None and "://" not in os.fspath(recordings):
            recordings = os.path.abspath(recordings)  # noqa: PTH100 - Ray runs processes in other folders
        super().__init__(recordings, checkpoint_every=checkpoint_every, **options)

    def __call__(self) -> Recording:
        """Return the callbacks of an algorithm; called by RLlib, once in each process."""
        return copy.copy(self)

    # --- in the process of the algorithm --------------------------------------------------------------

    def on_algorithm_init(self, *, algorithm: Algorithm, **_: object) -> None:
        """Begin the run, and have all env runners join it.

        Raises:
            RunnerError: one cannot record its environments.
        """
        run = self._begin(algorithm)
        for group in _groups(algorithm):
            if reason := self._join(run, group, group is not algorithm.env_runner_group):
                for joined in _groups(algorithm):
                    joined.foreach_env_runner(_leave)
                run._loop.close("failed", reason)
                raise RunnerError(reason)
        self._run = run
        stop = algorithm.cleanup

        def cleanup() -> None:
            try:
                self._end(algorithm)
            finally:
                stop()

        algorithm.cleanup = cleanup

    def _begin(self, algorithm: Algorithm) -> _Run:
        """Begin the run, with the spaces of the first env runner's environments.

        Raises:
            EnvironmentNotUsable: they cannot be recorded.
        """
        config = algorithm.config
        describe = partial(_described, self._options.get("make", ""))
        described_by = next(filter(None, algorithm.env_runner_group.foreach_env_runner(describe)), None)
        if described_by is None:
            raise EnvironmentNotUsable(
                f"found no environment in the env runners of {type(algorithm).__name__}, expected one"
            )
        described, maker = described_by
        name = f"{type(algorithm).__name__}-{described.env_id.rpartition('/')[2]}"
        if trial := getattr(getattr(algorithm, "_storage", None), "trial_dir_name", None):
            name = re.sub(r"_[\d-]{10}_[\d-]{8}$", "", trial)  # RLlib keeps no other name of a trial
        settings = {key: as_setting(value) for key, value in config.to_dict().items() if key != "callbacks"}
        options = options_of(
            self._recordings,
            {"name": as_run_name(name)}
            | self._arguments({"algorithm": type(algorithm).__name__, **settings}, config.seed),
            valid=CallbackOptions.__annotations__,
        )
        return _Run(Loop(described, options, maker))

    def _join(self, run: _Run, group: Any, is_evaluation: bool, **runners: object) -> str:
        """Have env runners record their environments; return why one of them cannot."""
        phase = "eval" if is_evaluation else "train"
        shared = {name: value for name, value in self._options.items() if name not in OF_THE_RUN}
        join = partial(_why_not_joined, {"join": run.run, "phase": phase, **shared})
        return next(filter(None, group.foreach_env_runner(join, **runners)), "")

    def on_env_runners_recreated(
        self, *, env_runner_group: Any, env_runner_indices: list[int], is_evaluation: bool, **_: object
    ) -> None:
        """Have env runners join that take the place of others which failed."""
        if self._run is None:
            return
        runners = {"remote_worker_ids": env_runner_indices, "local_env_runner": False}
        if reason := self._join(self._run, env_runner_group, is_evaluation, **runners):
            warn_user(f"run {self._run.run.run_id}: an env runner is not recorded any more: {reason}")

    def on_evaluate_start(self, *, algorithm: Algorithm, **_: object) -> None:
        """State in the evaluating env runners how many steps were trained on."""
        if self._run is not None and (group := algorithm.eval_env_runner_group) is not None:
            steps = algorithm.metrics.peek(("env_runners", _STEPS), default=0)
            group.foreach_env_runner(partial(_evaluate_at, int(steps)))

    def on_train_result(self, *, algorithm: Algorithm, result: Json, **_: object) -> None:
        """Log the result of an iteration, after the steps that it was sampled from."""
        if self._run is None:
            return
        steps = result.get(_STEPS, result.get("env_runners", {}).get(_STEPS, 0))
        self._run.at_step(int(steps))
        self._run.log(_numbers({key: result[key] for key in _RESULTS if key in result}))
        self._iterations += 1
        every = self._checkpoint_every
        if every and self._iterations % every == 0:
            _checkpoint(self._run, algorithm)

    def _end(self, algorithm: Algorithm) -> None:
        """End the run; the env runners are still there."""
        run, self._run = self._run, None
        if run is None:
            return
        every = self._checkpoint_every
        try:
            if every and self._iterations % every:
                _checkpoint(run, algorithm)
            for group in _groups(algorithm):
                group.foreach_env_runner(_leave)
        except Exception as failure:
            warn_user(
                f"run {run.run.run_id}: its env runners could not be asked to finish: "
                f"{truncated_message(failure)}"
            )
        run.close()

    # --- in the process of an env runner --------------------------------------------------------------

    def on_environment_created(self, *, env_runner: object, **_: object) -> None:
        """Record environments that an env runner made again."""
        if (join := getattr(env_runner, "_recorded_join", None)) is not None:
            _join(join, env_runner)


class _Run(Recorded):
    """The run of an algorithm, whose process takes no steps."""

    def __init__(self, loop: Loop) -> None:
        self.env = SimpleNamespace(close=lambda **_: None)
        self._record_into(loop)
        self._enter("train")


def _checkpoint(run: _Run, algorithm: Algorithm) -> None:
    """Keep the weights of the algorithm's module, or of the module of each policy."""
    policies = algorithm.config.policies if algorithm.config.is_multi_agent else ()
    modules = {name: algorithm.get_module(name) for name in policies} or {"module": algorithm.get_module()}
    for name, module in modules.items():
        state = flatten(module.get_state(inference_only=True), separator="/")
        if arrays := {key: value for key, value in state.items() if hasattr(value, "dtype")}:
            run.checkpoint(name, arrays)


def _groups(algorithm: Algorithm) -> Iterator[Any]:
    """Yield the groups of env runners of an algorithm: those that train, and those that evaluate."""
    groups = (algorithm.env_runner_group, getattr(algorithm, "eval_env_runner_group", None))
    yield from (group for group in groups if group is not None)


def _described(make: str, env_runner: Any) -> tuple[Described, EnvironmentMaker] | None:
    """Return the description of an env runner's environments; None without any.

    Raises:
        EnvironmentNotUsable: they cannot be recorded.
    """
    if (outer := getattr(env_runner, "env", None)) is None:
        return None
    if isinstance(outer, VectorMultiAgentEnv):
        game = _game(env_runner, outer.envs[0])
        return described_game(game), game_maker_of(game, make)
    if type(env_runner).__name__ != "SingleAgentEnvRunner" or not hasattr(outer, "env"):
        raise EnvironmentNotUsable(
            f"found a {type(env_runner).__name__} with a {type(outer).__name__}, expected RLlib's "
            "SingleAgentEnvRunner or MultiAgentEnvRunner. Record the environments in the function that makes "
            "them: runner.record(env, join=run)."
        )
    envs = outer.env
    mode = autoreset_mode_of(envs, None)
    with first_of(envs) as first:
        described = described_vector(envs, first, mode)
        return replace(described, environments=1, has_turns=False), vector_maker_of(envs, first, mode, make)


def _game(env_runner: Any, env: object) -> MultiAgent:
    """Return an environment of several agents as a game, with the class or registered function that made it.

    RLlib calls either with `env_config`, which a recording has to name.
    """
    kind = env_runner.config.env
    name = kind if isinstance(kind, str) else None
    creator = kind
    if name is not None and _global_registry.contains(ENV_CREATOR, name):
        creator = _global_registry.get(ENV_CREATOR, name)
    try:
        first = next(iter(inspect.signature(creator).parameters.values()), None)
    except (TypeError, ValueError):  # it is no function, or one without a signature, such as of compiled code
        first = None
    if first is None or first.kind not in (first.POSITIONAL_OR_KEYWORD, first.KEYWORD_ONLY):
        return MultiAgent(env, name)
    return MultiAgent(env, name, creator, {first.name: dict(env_runner.config.env_config)})


def _why_not_joined(options: Mapping[str, Any], env_runner: object) -> str:
    """Have an env runner record its environments; return why it cannot, because RLlib only logs an error."""
    try:
        _join(options, env_runner)
    except Exception as error:
        return truncated_message(error)
    return ""


def _join(options: Mapping[str, Any], env_runner: Any) -> None:
    """Record the environments of an env runner from now on; called in its process.

    Args:
        options: the arguments with which they are recorded, `join` and `phase` among them.
        env_runner: the env runner.
    """
    outer = getattr(env_runner, "env", None)
    if outer is None or _recorded(env_runner):
        return
    kind = "evaluation" if options["phase"] == "eval" else "env-runner"
    shard = f"{kind}-{env_runner.worker_index or 0}"
    folder = options["join"].folder
    if not folder.is_dir():
        raise RunnerError(
            f"found no folder {folder} on the node of an env runner, expected a recordings folder that all "
            "nodes share"
        )
    if isinstance(outer, VectorMultiAgentEnv):
        for i, env in enumerate(outer.envs):
            name = shard if len(outer.envs) == 1 else f"{shard}.{i}"
            outer.envs[i] = record_parallel(_game(env_runner, env), shard=name, **options)
    else:
        outer.env = record_vector(outer.env, shard=shard, **options)
    env_runner._recorded_join = options


def _recorded(env_runner: object) -> list[Recorded]:
    """Return what an env runner has recorded: its vector, or each of its environments of several agents."""
    outer = getattr(env_runner, "env", None)
    inner = outer.envs if isinstance(outer, VectorMultiAgentEnv) else [getattr(outer, "env", None)]
    return [env for env in inner if isinstance(env, Recorded)]


def _evaluate_at(steps: int, env_runner: object) -> None:
    """State after how many training steps an env runner evaluates; called in its process."""
    for recorded in _recorded(env_runner):
        recorded.at_step(steps)


def _leave(env_runner: object) -> None:
    """End the shards of an env runner; called in its process."""
    for recorded in _recorded(env_runner):
        recorded._loop.close()


def _numbers(values: Mapping[str, object]) -> dict[str, float]:
    """Return the numbers in nested mappings by their names, joined by `/`."""
    return {
        name: float(value)
        for name, value in flatten(values, separator="/").items()
        if isinstance(value, int | float | np.number) and not _CLOCK.search(name)
    }
