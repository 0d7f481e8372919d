"""Numba's rules of compilation, loaded: the process that others are forked from imports this module last.

A process needs them for its first kernel, even for one from the cache; loading them takes 0.3 s.
"""

from __future__ import annotations

import contextlib
import gc

from numba.core.registry import cpu_target

import runner.learning  # noqa: F401 - keeps SciPy out of them

with contextlib.suppress(AttributeError):  # internals of Numba, which may change
    cpu_target.typing_context.refresh()
    cpu_target.target_context.refresh()
gc.freeze()  # no child searches what it shares with the others, nor does this process at its end
