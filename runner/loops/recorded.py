"""What every recorded environment has: its run, the calls that record more than steps, its end."""

from __future__ import annotations

import contextlib
import sys
import weakref
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, Self

import numpy as np

from runner.environments.gym_types import Info, ResetOptions, ResetResult
from runner.errors import ConfigError
from runner.loops.generators import GeneratorWatch, States
from runner.loops.loop import Loop
from runner.loops.messages import Messages
from runner.loops.options import Arguments, Options
from runner.loops.step_buffer import StepBuffer
from runner.runs.run import Run
from runner.util.arrays import Flags


class Recorded:
    """What every recorded environment has besides the environment; a context manager."""

    env: Any
    _loop: Loop
    _messages: Messages
    _options: Options
    _return_name = ""
    """The name under which returns before a wrapper changed them are logged; empty if none did."""
    _until_frame = 0
    """Steps up to the next frame."""
    _owner: Recorded | None = None
    """The recorded environment that closes the recording, if it is another; this one keeps it alive."""
    _phase: str
    _rows: StepBuffer
    _watch: GeneratorWatch

    @property
    def run(self) -> Run:
        """The run that is recorded; it has a `summary` once it is closed."""
        return self._loop.run

    @property
    def should_stop(self) -> bool:
        """Whether the run's page, or somebody else, requested that the training stops.

        The request is noticed within about a second; the loop has to look, and to end by itself.
        """
        return self._loop.should_stop

    def _log_return(self, info: Info, ended: Flags | bool = True) -> None:
        """Log the mean return of episodes that just ended, as their statistics inside of wrappers have it."""
        for values in (info, info.get("final_info")):
            statistics = values.get("episode") if isinstance(values, Mapping) else None
            if isinstance(statistics, Mapping) and "r" in statistics:
                returns = np.atleast_1d(np.asarray(statistics["r"], np.float64))[np.atleast_1d(ended)]
                if len(returns):
                    self._messages.log(self._phase, self._return_name, float(returns.mean()))

    def log(self, name: str | Mapping[str, object], value: object = None) -> None:
        """Record a value under a name: `rec.log("loss", loss)`, `rec.log({"loss": loss})`.

        A number, a text, an array of numbers, a figure of Matplotlib, a picture of Pillow, or an `Image`,
        `Video` or `Histogram` of `runner.loops.media`. Several numbers are recorded as by `snapshot`.

        Raises:
            ConfigError: it is something else.
            MissingExtra: pictures need Pillow, which is not installed.
        """
        try:
            if isinstance(name, str):
                self._messages.log(self._phase, name, value)
                return
            if not isinstance(name, Mapping) or value is not None:
                raise ConfigError(f"log: found {name!r}, expected a name and a value, or a mapping of them")
        except Exception as error:
            self._loop.leave_out(error)
            return
        for key, item in name.items():
            if isinstance(item, Mapping):
                self.log({f"{key}/{inner}": part for inner, part in item.items()})
            else:
                self.log(key, item)

    def snapshot(self, name: str, array: object) -> None:
        """Record an array of numbers, or each of a mapping of arrays, as it is now: `rec.snapshot("q", q)`.

        Tensors of PyTorch and JAX are accepted too; their short floats, such as bfloat16, become float32.
        The arrays of a mapping, such as a `state_dict`, are named `name/key`.

        Raises:
            ConfigError: it holds something else, or an array is larger than 64 MB.
        """
        try:
            self._messages.snapshot(self._phase, name, array)
        except Exception as error:
            self._loop.leave_out(error)

    def checkpoint(self, name: str, value: object, *, pickle: bool = False) -> str:
        """Keep the agent's parameters as they are now: `rec.checkpoint("policy", model.state_dict())`.

        The content goes into a store next to the runs, once for equal contents; the recording has its digest,
        with the step.

        Args:
            name: its name, without `@`.
            value: bytes, the path of a file, or a mapping of arrays or tensors, which becomes safetensors.
            pickle: record any object by pickling it; it can be loaded only by those who trust it.

        Returns:
            The digest of the content, in hexadecimal; empty if it could not be kept, with `on_error="warn"`.

        Raises:
            ConfigError: the name or the value cannot be recorded.
            MissingExtra: a mapping needs safetensors, which is not installed.
            StorageError: the file cannot be read, or the store cannot be written.
        """
        try:
            return self._messages.checkpoint(self._phase, name, value, pickle)
        except Exception as error:
            self._loop.leave_out(error)
            return ""

    def note_step(self, values: Mapping[str, object] | None = None, /, **more: object) -> None:
        """Record values with the last step, as `step(action, extras={...})` does.

            rec.note_step(td_error=error)
            rec.note_step({"td error": error})

        A name keeps the dtype and the shape of its first value; the first axis of arrays may have another
        length, and texts are recorded too. In a vector environment a value is an array [N, ...], or a list of
        N arrays or texts; with several agents it is a mapping of names for each agent.

        Raises:
            ConfigError: a name or a value cannot be recorded, or no step of this phase was taken since the
                last step of the other phase.
        """
        try:
            self._loop.note(self._phase, self._rows, self._extras_by_name({**(values or {}), **more}))
        except Exception as error:
            self._loop.leave_out(error)

    def _extras_by_name(self, values: Mapping[str, object]) -> Mapping[str, object]:
        return values

    def at_step(self, steps: int) -> None:
        """State how many training steps the whole run had: what follows is recorded as of that moment.

            rec = runner.record(env, join=run, phase="eval")
            rec.at_step(learner.steps)     # then evaluate the policy of that moment

        For processes of one run that take no training steps themselves, such as evaluators; without it, what
        they record stands where the others were after as many steps of their own.

        Raises:
            ConfigError: it is no number of steps, or lower than before.
            RunnerError: this process takes training steps itself, or the recording is closed.
        """
        self._loop.at_step(steps)

    @contextlib.contextmanager
    def phase(self, name: str) -> Iterator[Self]:
        """Record what happens in the block in this phase, `train` or `eval`: `with rec.phase("eval"):`.

        Each phase has its own episodes, so begin and end it with `reset()`.

        Raises:
            ConfigError: there is no such phase.
        """
        before = self._phase
        self._enter(name)
        try:
            yield self
        finally:
            self._enter(before)

    def close(self, **kwargs: object) -> None:
        """Close the environment, and the recording as finished unless it belongs to another environment."""
        self._end(kwargs)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> Literal[False]:
        self._end({}, *ending_of(raised[1]))
        return False

    def _end(self, arguments: Arguments, *ending: str) -> None:
        """Close the environment with some arguments, and the recording with a status and an error."""
        try:
            self.env.close(**arguments)
        finally:
            if self._owner is None:
                self._loop.close(*ending)

    def _enter(self, phase: str) -> None:
        self._phase = phase
        self._rows = self._loop.rows(phase)
        self._take_extras = self._loop.extras.taker(phase, self._rows)

    def _reset(
        self,
        seeds: Sequence[int | None],
        environments: Sequence[int],
        recorded: ResetOptions | None,
        arguments: Arguments,
    ) -> ResetResult:
        """Reset environments, and record it: the seeds, the options, the observations.

        Args:
            seeds: of all environments; empty for none.
            recorded: the options that are recorded.
            arguments: of the environment's `reset`; None is left out, as it may lack that argument.
        """
        text = self._messages.options_text(recorded)
        states = self._watch.before_reset(environments, seeds)
        result: ResetResult = self.env.reset(
            **{name: value for name, value in arguments.items() if value is not None}
        )
        try:
            states = self._watch.after_reset(states, environments, seeds)
            self._record_reset(*result, seeds, environments, states, text)
        except Exception as error:
            self._loop.fail(error)
        return result

    def _record_reset(
        self,
        observations: object,
        infos: Any,
        seeds: Sequence[int | None],
        environments: Sequence[int],
        states: States,
        options: str,
    ) -> None:
        """Record a reset of environments that was just done; arguments as for `StepBuffer.reset`."""
        with self._loop.lock:
            if not self._loop.activate(self._rows):
                return
            self._rows.reset(observations, seeds, environments, states, options)
        if self._options.info:
            self._messages.info(self._phase, self._info_by_field(infos), is_reset=True)
        if self._options.frames_every:
            self._record_frames(resets=np.isin(range(self._loop.described.environments), environments))

    def _info_by_field(self, info: Any) -> Info:
        return info  # type: ignore[no-any-return]

    def _record_frames(self, resets: Any = False, ends: Flags | bool = False) -> None:
        """Record pictures of the environments that were reset or whose episode ended, now and then of all."""
        n = self._loop.described.environments
        frames_of = self._options.frames_of
        resets, is_due = np.broadcast_to(resets, n), np.broadcast_to(resets | np.asarray(ends), n)
        if self._until_frame <= 0 or resets.all():
            self._until_frame = self._options.frames_every
            is_due = np.ones(n, np.bool_)
        due = [i for i in (range(n) if frames_of is None else frames_of) if is_due[i]]
        images = self._pictures(due) if due else ()
        if images is None or len(images) < len(due):
            raise ConfigError(f"frames: found {type(images).__name__} from render(), expected {n} pictures.")
        for i in due:
            environment = None if self._loop.mode is None else i
            self._messages.frame(self._phase, images[i], bool(resets[i]), environment)

    def _pictures(self, due: Sequence[int]) -> Any:
        """Return pictures of environments, by number."""
        return {i: self.env.render() for i in due}

    def _record_into(self, loop: Loop, is_owner: bool = True) -> None:
        """Record into a loop; its owner closes it when the process ends, if not before."""
        self._loop = loop
        self._messages = loop.messages
        self._options = loop.options
        if is_owner:
            weakref.finalize(self, _close_abandoned, loop)


def ending_of(error: object) -> tuple[str, str]:
    """Return the status of a run that ended with this error, None without one, and the text of the error."""
    if error is None or isinstance(error, GeneratorExit):  # a loop over a generator was left by `break`
        return "finished", ""
    if isinstance(error, KeyboardInterrupt) or (isinstance(error, SystemExit) and not error.code):
        return "interrupted", ""
    return "failed", f"{type(error).__name__}: {error}"


def _close_abandoned(loop: Loop) -> None:
    """Close a recording that was not closed: as failed if an uncaught exception ended the process.

    Python keeps such an exception in `sys.last_value`; an interactive session continues after it.
    """
    error = getattr(sys, "last_value", None)
    is_interactive = bool(sys.flags.interactive) or hasattr(sys, "ps1")
    loop.close(*(("interrupted", "") if error is None or is_interactive else ending_of(error)))


def require_pictures(env: object) -> None:
    """Refuse an environment that renders no pictures, in a run with frames.

    Raises:
        ConfigError: it is made with another `render_mode` than "rgb_array".
    """
    mode = getattr(env, "render_mode", None)
    if mode != "rgb_array":
        raise ConfigError(
            f"frames_every: found an environment with render_mode={mode!r}, expected "
            "'rgb_array': make it with render_mode=\"rgb_array\"."
        )


def return_name(names: Sequence[str]) -> str:
    """Return the name under which the returns of episode statistics are logged; empty if there is no need.

    Statistics of episodes inside of a wrapper that changes rewards, such as `NormalizeReward`, have returns
    that the recorded rewards do not show.

    Args:
        names: the wrappers, `module:class`, from the outermost in.
    """
    classes = [name.rpartition(":")[2] for name in names]
    inside = next((at for at, name in enumerate(classes) if name == "RecordEpisodeStatistics"), 0)
    changing = [name for name in classes[:inside] if "Reward" in name]
    return f"return before {changing[-1]}" if changing else ""
