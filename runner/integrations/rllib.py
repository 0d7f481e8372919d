"""RLlib: `config.callbacks(runner.integrations.rllib.Recording(name="ppo"))`, for its present API stack.

The algorithm's process begins the run. Each env runner, also one that evaluates, records its environments as
a shard of that run; they are put together when the algorithm is stopped.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import SimpleNamespace
from typing import Any, Final, Unpack

import numpy as np

from runner.errors import ConfigError, EnvironmentNotUsable, RunnerError, truncated_message
from runner.integrations.libraries import require_tested
from runner.loops.description import Described
from runner.loops.loop import Loop
from runner.loops.makers import checked_make, vector_maker_of
from runner.loops.options import PackingOptions, options_of
from runner.loops.recorded import Recorded
from runner.loops.rows import Rows
from runner.loops.single_rows import ROWS
from runner.loops.values import warn_user
from runner.loops.vector import (
    RecordedVector,
    autoreset_mode_of,
    described_vector,
    first_of,
    record_vector,
    require_fixed,
)
from runner.recording.maker import EnvironmentMaker
from runner.runs.run import Run
from runner.util.jsonable import as_json, as_mapping
from runner.util.values import Json, is_whole

require_tested("ray", "rllib", ("2.60", "2.60"))

from ray.rllib.algorithms.algorithm import Algorithm  # noqa: E402
from ray.rllib.callbacks.callbacks import RLlibCallback  # noqa: E402

_RESULTS: Final = ("training_iteration", "evaluation", "env_runners", "learners")
"""What is logged of an iteration's result."""
_CLOCK: Final = re.compile(r"(^|/)(timers|sample|[^/]*(_timer|throughput|_sec_|_between_)[^/]*)(/|$)")
"""What is not logged, because it differs between two runs that are otherwise the same."""
_STEPS: Final = "num_env_steps_sampled_lifetime"


@dataclass(frozen=True)
class _Join:
    """What an env runner needs to record its environments."""

    run: Run
    phase: str
    options: Mapping[str, Any]


class Recording:
    """Records what the env runners of an algorithm do, and the results of its iterations.

        config = PPOConfig().environment("CartPole-v1").callbacks(runner.integrations.rllib.Recording())

    Each algorithm that is built from the configuration is a run, which ends with `algorithm.stop()`. In Ray
    Tune each trial is a run, and has its name.

    Args:
        recordings: the recordings folder, which all nodes share; by default $DUALTAXI_RECORDINGS or
            ./recordings.
        name: the name of the run; in Ray Tune that of the trial, else algorithm and environment.
        seed: the seed that the run is listed with; the configuration's unless given.
        config: your own settings, next to those of the algorithm.
        info: names of fields of the infos to record.
        make: a function that makes one of the environments, where it cannot be made from what is recorded.
        checkpoint_every: keep the module's weights as the checkpoint `module` after this many iterations, and
            at the end; 0 for none.
        packing: as for `runner.record`.

    Raises:
        ConfigError: an argument cannot be used.
    """

    def __init__(
        self,
        recordings: str | os.PathLike[str] | None = None,
        *,
        name: str | None = None,
        seed: int | None = None,
        config: object = None,
        info: Sequence[str] = (),
        make: str | Callable[[], object] | None = None,
        checkpoint_every: int = 0,
        **packing: Unpack[PackingOptions],
    ) -> None:
        given = {"name": name, "seed": seed, "config": config, "info": info}
        options_of(recordings, {**given, **packing}, valid=(*PackingOptions.__annotations__, *given))
        self.make, self.options = make, {"info": tuple(info), **packing}
        if not is_whole(checkpoint_every, 0, 2**62):
            raise ConfigError(f"checkpoint_every: found {checkpoint_every!r}, expected a whole number from 0")
        folder = recordings if recordings is None else os.fspath(recordings)
        self.recordings = folder if folder is None or "://" in folder else os.path.abspath(folder)  # noqa: PTH100
        """Ray runs some of the processes in folders of its own."""
        self.name, self.seed, self.config = name, seed, dict(as_mapping(config) or {})
        self.checkpoint_every = checkpoint_every

    def __call__(self) -> RLlibCallback:
        """Return the callbacks; called by RLlib, once in each process."""
        return _Callbacks(self)


class _Run(Recorded[Rows]):
    """The run of an algorithm, whose process takes no steps."""

    def __init__(self, loop: Loop[Rows]) -> None:
        self.env = SimpleNamespace(close=lambda **_: None)
        self._record_into(loop)
        self._enter("train")

    def end(self, error: str = "") -> None:
        """Close the run."""
        self._loop.close("failed" if error else "finished", error)


class _Callbacks(RLlibCallback):  # type: ignore[misc]
    """What RLlib calls: in the algorithm's process, and in those of env runners."""

    def __init__(self, recording: Recording) -> None:
        super().__init__()
        self._recording = recording
        self._run: _Run | None = None
        self._iterations = 0

    # --- in the process of the algorithm --------------------------------------------------------------

    def on_algorithm_init(self, *, algorithm: Algorithm, **_: object) -> None:
        """Begin the run, and have all env runners join it."""
        self._run = self._begin(algorithm)
        for group in _groups(algorithm):
            group.foreach_env_runner(self._joining(group is not algorithm.env_runner_group))
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
        recording, config = self._recording, algorithm.config
        describe = partial(_described, checked_make(recording.make))
        found = [each for each in algorithm.env_runner_group.foreach_env_runner(describe) if each]
        if not found:
            raise EnvironmentNotUsable(
                f"found no environment in the env runners of {type(algorithm).__name__}, expected one"
            )
        described, maker = found[0]
        name = f"{type(algorithm).__name__}-{described.env_id.rpartition('/')[2]}"
        if trial := getattr(getattr(algorithm, "_storage", None), "trial_dir_name", None):
            name = re.sub(r"_[\d-]{10}_[\d-]{8}$", "", trial)  # RLlib keeps no other name of a trial
        options = options_of(
            recording.recordings,
            {
                "name": recording.name or re.sub(r"[^A-Za-z0-9_.+/-]", "-", name)[:100],
                "seed": config.seed if recording.seed is None else recording.seed,
                "config": {**_settings(algorithm), **recording.config},
                **recording.options,
            },
        )
        return _Run(Loop(described, options, maker, ROWS[described.kind]))

    def _joining(self, is_evaluation: bool) -> Callable[[object], None]:
        """Return what has an env runner record its environments; it is sent to the process of each."""
        assert self._run is not None
        phase = "eval" if is_evaluation else "train"
        return partial(
            _join, _Join(self._run.run, phase, {"make": self._recording.make, **self._recording.options})
        )

    def on_env_runners_recreated(
        self, *, env_runner_group: Any, env_runner_indices: list[int], is_evaluation: bool, **_: object
    ) -> None:
        """Have env runners join that take the place of others which failed."""
        if self._run is not None:
            env_runner_group.foreach_env_runner(
                self._joining(is_evaluation), remote_worker_ids=env_runner_indices, local_env_runner=False
            )

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
        self._run.log(dict(_numbers({key: result[key] for key in _RESULTS if key in result})))
        self._iterations += 1
        every = self._recording.checkpoint_every
        if every and self._iterations % every == 0:
            self._checkpoint(algorithm)

    def _checkpoint(self, algorithm: Algorithm) -> None:
        """Keep the weights of the algorithm's module."""
        assert self._run is not None
        state = dict(_arrays(algorithm.get_module().get_state(inference_only=True)))
        self._run.checkpoint("module", state)

    def _end(self, algorithm: Algorithm) -> None:
        """End the run; the env runners are still there."""
        if self._run is None:
            return
        run, self._run, error = self._run, None, ""
        every = self._recording.checkpoint_every
        try:
            if every and self._iterations % every:
                self._run = run
                self._checkpoint(algorithm)
                self._run = None
            for group in _groups(algorithm):
                group.foreach_env_runner(_leave)
        except Exception as failure:
            error = truncated_message(failure)
            warn_user(f"run {run.run.run_id}: its env runners could not be asked to finish: {error}")
        run.end()

    # --- in the process of an env runner --------------------------------------------------------------

    def on_environment_created(self, *, env_runner: object, **_: object) -> None:
        """Record environments that an env runner made again."""
        if (join := getattr(env_runner, "_recorded_join", None)) is not None:
            _join(join, env_runner)


def _groups(algorithm: Algorithm) -> Iterator[Any]:
    """Yield the groups of env runners of an algorithm: those that train, and those that evaluate."""
    groups = (algorithm.env_runner_group, getattr(algorithm, "eval_env_runner_group", None))
    yield from (group for group in groups if group is not None)


def _inner(env_runner: object) -> tuple[Any, Any]:
    """Return the wrapper of RLlib around the vector of an env runner, and the vector; None without one.

    Raises:
        EnvironmentNotUsable: it has environments of several agents.
    """
    wrapper = getattr(env_runner, "env", None)
    if wrapper is None:
        return None, None
    if type(env_runner).__name__ != "SingleAgentEnvRunner" or not hasattr(wrapper, "env"):
        raise EnvironmentNotUsable(
            f"found a {type(env_runner).__name__} with a {type(wrapper).__name__}, expected RLlib's "
            "SingleAgentEnvRunner: environments of several agents cannot be recorded through RLlib. Record "
            "them in a function that makes them: runner.record_parallel(env, join=run)."
        )
    return wrapper, wrapper.env


def _described(make: str, env_runner: object) -> tuple[Described, EnvironmentMaker] | None:
    """Return the description of an env runner's environments; None without any."""
    _, envs = _inner(env_runner)
    if envs is None:
        return None
    mode = autoreset_mode_of(envs, None)
    with first_of(envs) as first:
        described = described_vector(envs, first)
        require_fixed(described)
        return replace(described, environments=1), vector_maker_of(envs, first, mode, make)


def _join(join: _Join, env_runner: Any) -> None:
    """Record the environments of an env runner from now on; called in its process."""
    wrapper, envs = _inner(env_runner)
    if envs is None or isinstance(envs, RecordedVector):
        return
    kind = "evaluation" if join.phase == "eval" else "env-runner"
    shard = f"{kind}-{env_runner.worker_index or 0}"
    if not join.run.folder.is_dir():
        raise RunnerError(
            f"found no folder {join.run.folder} on the node of an env runner, expected a recordings folder "
            "that all nodes share"
        )
    wrapper.env = record_vector(envs, join=join.run, shard=shard, phase=join.phase, **join.options)
    env_runner._recorded_join = join


def _recorded(env_runner: object) -> RecordedVector | None:
    envs = getattr(getattr(env_runner, "env", None), "env", None)
    return envs if isinstance(envs, RecordedVector) else None


def _evaluate_at(steps: int, env_runner: object) -> None:
    """State after how many training steps an env runner evaluates; called in its process."""
    if (recorded := _recorded(env_runner)) is not None:
        recorded.at_step(steps)


def _leave(env_runner: object) -> None:
    """End the shard of an env runner; called in its process."""
    if (recorded := _recorded(env_runner)) is not None:
        recorded._loop.close()


def _numbers(values: Mapping[object, object], prefix: str = "") -> Iterator[tuple[str, float]]:
    """Yield the numbers in nested mappings by their names, joined by `/`."""
    for key, value in values.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from _numbers(value, f"{name}/")
        elif isinstance(value, int | float | np.number) and not _CLOCK.search(name):
            yield name, float(value)


def _arrays(state: Mapping[object, object], prefix: str = "") -> Iterator[tuple[str, object]]:
    """Yield the arrays in nested mappings by their names, joined by `/`."""
    for key, value in state.items():
        if isinstance(value, Mapping):
            yield from _arrays(value, f"{prefix}{key}/")
        elif hasattr(value, "dtype"):
            yield f"{prefix}{key}", value


def _settings(algorithm: Algorithm) -> dict[str, object]:
    """Return the configuration of an algorithm as JSON holds it; what JSON cannot hold, as text."""
    found: dict[str, object] = {"algorithm": type(algorithm).__name__}
    for key, value in algorithm.config.to_dict().items():
        if key == "callbacks":
            continue
        try:
            own = as_json(value)
        except (ValueError, RecursionError):
            own = type(value).__name__
        found[str(key)] = type(value).__name__ if " at 0x" in json.dumps(own) else own
    return found
