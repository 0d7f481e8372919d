"""Libraries whose workers make environments by a function: the environments of all workers are one run.

An adapter derives from `Workers` and states how an environment of its library is recorded.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from typing import Any, Final, Self, Unpack

from runner.loops.env import record
from runner.loops.options import RecordOptions
from runner.loops.recorded import Recorded
from runner.runs.run import Run

_OF_THE_RUN: Final = ("name", "seed", "config", "run_id")
"""The arguments of `runner.record` that a process which joins a run does not give."""


class Workers:
    """Records the environments that a library makes by a function, in this process or in others, as one run.

    `train` makes an environment that joins the run: give it to the library in the place of the function.
    `recorded` is what `runner.record` returns, for `log` and `checkpoint`; it takes no steps. Close the
    workers, then this; it is a context manager.

    Args:
        make: makes an environment; it has to be sent to the workers, as without recording.
        recordings: as for `runner.record`.
        options: the others of `runner.record`.

    Raises:
        ConfigError: an argument cannot be used.
        EnvironmentNotUsable: a space cannot be recorded.
        StorageError: the recordings folder cannot be written.
    """

    record: Callable[..., Any] = staticmethod(record)
    """Records an environment of the library, with the arguments of `runner.record`."""

    def __init__(
        self,
        make: Callable[[], Any],
        recordings: str | os.PathLike[str] | None = None,
        **options: Unpack[RecordOptions],
    ) -> None:
        self._env = self.record(make(), recordings, **options)  # it may close itself when it is collected
        self.recorded = self.inside(self._env)
        shared = {name: value for name, value in options.items() if name not in _OF_THE_RUN}
        self.train = partial(_made, self.record, make, join=self.run, **shared)

    @staticmethod
    def inside(env: Any) -> Recorded:
        """Return the recorded environment inside of one of the library."""
        return env  # type: ignore[no-any-return]

    @property
    def run(self) -> Run:
        """The run; it has a `summary` once it is closed."""
        return self.recorded.run

    def close(self) -> None:
        """Put together what the workers recorded, and close the run as finished."""
        self.recorded.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        self.recorded.__exit__(*raised)


def _made(record: Callable[..., Any], make: Callable[[], Any], **options: object) -> Any:
    """Return a recorded environment; called in the process of a worker."""
    return record(make(), **options)
