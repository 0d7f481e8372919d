"""How kernels are compiled: decorators, a notice before compilation, and a cache that notices changed files.

Numba compares only the file of a function. A function that calls, or inlines, functions of other files would
be taken from the cache as it was before those were edited.
"""

from __future__ import annotations

import glob
import hashlib
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Final
from uuid import uuid4

import numba
from numba.core import caching, event
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import cpu_target

from runner.util.compilation import announce


def watch(module: str) -> None:
    """Recompile the functions of a package when any Python file of its folder has changed.

    Args:
        module: the package's file; call this before its functions are decorated.
    """
    folder = Path(module).resolve().parent

    class Locator:
        """Numba's own choice of a cache folder, with a stamp of the whole package."""

        @classmethod
        def from_function(cls, function: object, file: str) -> object:
            """Return the locator of a function; None if it is not of this folder."""
            if Path(file).resolve().parent != folder:
                return None
            others = (other for other in caching.CacheImpl._locator_classes if other is not cls)
            locator = next(filter(None, (other.from_function(function, file) for other in others)), None)
            if locator is not None:
                locator.get_source_stamp = lambda: stamp(folder)
            return locator

    caching.CacheImpl._locator_classes.insert(0, Locator)


@cache
def stamp(folder: Path) -> str:
    """Return a hash of a folder's Python files, their names and contents."""
    files = {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in folder.glob("*.py")}
    return hashlib.sha256(repr(sorted(files.items())).encode()).hexdigest()


def leave_out_scipy() -> None:
    """Let Numba load what it needs before its first function without SciPy, whose import takes longer.

    Numba imports SciPy's BLAS only to see whether it is there. A function that needs it, which no kernel here
    does, imports it when it is compiled.
    """
    context = cpu_target.target_context
    if "refresh" in vars(context):
        return
    refresh = context.refresh

    def refresh_without_scipy() -> None:
        with global_compiler_lock:
            vars(context).pop("refresh", None)
            if find_spec("scipy") is not None:
                from numba.np import linalg

                ensure_blas, linalg.ensure_blas = linalg.ensure_blas, lambda: None
                try:
                    import numba.np.arraymath  # noqa: F401 - it looks for BLAS, once
                finally:
                    linalg.ensure_blas = ensure_blas
            refresh()

    context.refresh = refresh_without_scipy


_load_index = caching.IndexDataCacheFile._load_index


def _load_readable_index(file: caching.IndexDataCacheFile) -> dict[object, str]:
    """Return the entries of an index; none if it names a class that an update of this package took away."""
    try:
        entries: dict[object, str] = _load_index(file)
        return entries
    except (AttributeError, ImportError):
        return {}


def _save(file: caching.IndexDataCacheFile, key: object, data: object) -> None:
    """Add an entry: its data under a name of its own, and only then the index that names it.

    Numba writes the index first, and numbers the data: a process that was killed in between, or another one
    at the same time, would leave an index that names the data of other code.
    """
    entries = file._load_index()
    if not entries:  # of other code, or none: what is there was made of other code, too
        prefix = file._data_name_pattern.partition("{")[0]
        for stale in Path(file._cache_path).glob(f"{glob.escape(prefix)}*.nbc"):
            stale.unlink(missing_ok=True)
    entries[key] = file._data_name(uuid4().int)
    file._save_data(entries[key], data)
    file._save_index(entries)


caching.IndexDataCacheFile._load_index = _load_readable_index
caching.IndexDataCacheFile.save = _save


class _Announcement(event.Listener):  # type: ignore[misc]  # Numba has no types
    def on_start(self, _event: object) -> None:
        announce()

    def on_end(self, _event: object) -> None:
        pass


event.register("numba:compile", _Announcement())
# Numba sends the event after it has not found the signature in its cache, so a compilation does follow.


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
