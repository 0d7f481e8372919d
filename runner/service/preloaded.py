"""Numba's rules of compilation, loaded: the process that others are forked from imports this module last.

A process needs them for its first kernel, even for one from the cache; loading them takes 0.3 s.
"""

from __future__ import annotations

import contextlib

from numba.core.registry import cpu_target

import runner.learning  # noqa: F401 - keeps SciPy out of them

with contextlib.suppress(AttributeError):  # internals of Numba, which may change
    cpu_target.typing_context.refresh()
    cpu_target.target_context.refresh()
