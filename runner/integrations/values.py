"""A recording of logged values alone, without an environment."""

from __future__ import annotations

import os
from typing import Any, Final

from gymnasium.spaces import Discrete

from runner.loops.description import Described
from runner.loops.loop import Loop
from runner.loops.options import PACKING, options_of
from runner.recording.maker import EnvironmentMaker
from runner.recording.run_file import NO_ENVIRONMENT

_NO_ENVIRONMENT: Final = Described(Discrete(1), Discrete(1), env_id=NO_ENVIRONMENT)
_NOT_MADE: Final = EnvironmentMaker("gymnasium", reason="values were logged, and no environment was recorded")
_ARGUMENTS: Final = {*PACKING, "name", "on_error", "seed", "config", "run_id"}
"""The arguments of `record` that need no environment."""
_MAX_POSITION: Final = 2**37
"""The last step that has a time of its own; later ones are ordered as they came."""


class ValueRows:
    """Where values stand in a run without an environment: the script's own step."""

    off_table = 0

    def __init__(self) -> None:
        self.progress = (0, 0)
        self.pending = 0
        """The largest step so far, which orders the messages in time."""

    def move(self, step: int) -> None:
        """Let the next values have this step."""
        self.progress = (step, 0)
        self.pending = max(self.pending, min(step, _MAX_POSITION))

    def commit(self) -> None:
        """Do nothing: there are no steps."""

    def reshape(self, described: Described) -> None:
        """Do nothing: there are no actions."""


def begin_values(recordings: str | os.PathLike[str] | None, **arguments: Any) -> tuple[Loop, ValueRows]:
    """Begin a recording without an environment; arguments of `record` that need one are ignored.

    Raises:
        ConfigError: an argument cannot be used.
        StorageError: the recordings folder cannot be written.
    """
    given = {key: value for key, value in arguments.items() if key in _ARGUMENTS}
    rows = ValueRows()
    options = options_of(recordings, given)
    loop = Loop(_NO_ENVIRONMENT, options, _NOT_MADE, make_rows=lambda *_: rows)  # type: ignore[arg-type]
    loop.activate(loop.rows("train"))
    return loop, rows
