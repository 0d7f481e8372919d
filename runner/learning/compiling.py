"""How the loops of this package, and what they call, are compiled."""

from __future__ import annotations

from typing import Final

import numba

loop = numba.njit(cache=True, nogil=True, _nrt=False, no_cfunc_wrapper=True)
"""Compiles a loop. It allocates nothing, so it need not count references to its arrays (`_nrt`): inlined
functions would count them at every step, atomically, and take four times as long."""
INLINED: Final = {
    "cache": True,
    "forceinline": True,
    "_nrt": False,
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
}
inlined = numba.njit(**INLINED)
"""Compiles a function that takes arrays and is called by loops alone. LLVM inlines it; if Numba did so first
(`inline="always"`), a loop would be as fast and take two to four times as long to compile. Cached, so that
loops of another algorithm, in another process, take half as long to compile. A literal argument, such as 0,
has a type of its own, for which all is compiled again; `np.int64(0)` has that of any number."""
