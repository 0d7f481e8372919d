"""Work that every process needs, done once: the process that others are forked from imports this module last.

That is loading Numba's rules of compilation, which it needs for its first kernel, even for one from the cache
(0.3 s), and compiling the template of answers (0.05 s).
"""

from __future__ import annotations

import contextlib

from numba.core.registry import cpu_target

import runner.learning  # noqa: F401 - keeps SciPy out of them
from runner.errors import RunnerError
from runner.export.reports.rendering import partials

with contextlib.suppress(AttributeError):  # internals of Numba, which may change
    cpu_target.typing_context.refresh()
    cpu_target.target_context.refresh()
with contextlib.suppress(RunnerError):  # the extra is not installed
    partials()
