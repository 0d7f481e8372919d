"""Adapters that record the training loops of other libraries, a module for each library.

`runner.integrations.sb3` is imported when it is first used, and the library with it; `import runner` and
`import runner.integrations` import none of them.
"""

from __future__ import annotations

import importlib
import pkgutil
from typing import Any

_MODULES = tuple(module.name for module in pkgutil.iter_modules(__path__))


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return importlib.import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}, but {', '.join(_MODULES)}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES})
