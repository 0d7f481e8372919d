"""The libraries that adapters are for: imported when an adapter is used, with versions that were tested."""

from __future__ import annotations

import re
from importlib import metadata

from runner.loops.values import warn_user
from runner.util.extras import require


def require_tested(module: str, extra: str, tested: tuple[str, str]) -> object:
    """Import the library of an adapter; warn if its version is not one of those that were tested.

    Args:
        module: the library's module, such as `stable_baselines3`.
        extra: the extra of the project that installs it.
        tested: the first and the last version that were tested, such as ("2.6", "2.9"); every version that
            begins with the last one counts.

    Raises:
        MissingExtra: it is not installed.
    """
    library = require(module, extra=extra, purpose=f"runner.integrations.{extra}")
    package = metadata.packages_distributions().get(module, [module])[0]
    version = metadata.version(package)
    low, high = (_numbers(text) for text in tested)
    found = _numbers(version)
    if found[: len(low)] < low or found[: len(high)] > high:
        warn_user(
            f"runner.integrations.{extra}: found {package} {version}, tested are {tested[0]} to "
            f"{tested[1]}. Check the first recording."
        )
    return library


def _numbers(version: str) -> tuple[int, ...]:
    """Return the numbers that a version begins with."""
    return tuple(map(int, re.findall(r"\d+", re.match(r"[\d.]*", version)[0])))  # type: ignore[index]
