"""The settings and the summary of a run with the shape of wandb's."""

from __future__ import annotations

from collections.abc import Callable, Iterator, MutableMapping
from typing import Any

from runner.errors import RunnerError
from runner.integrations.script import ScriptRun
from runner.util.values import Json


class Config(MutableMapping[str, Any]):
    """The settings of a run: `config["lr"]`, `config.lr`, `config.update({...})`."""

    _script: ScriptRun
    _configure: Callable[..., None]

    def __init__(self, script: ScriptRun, configure: Callable[..., None]) -> None:
        vars(self).update(_script=script, _configure=configure)

    def update(self, *settings: Any, **more: object) -> None:
        """Take the settings of a mapping, dataclass or namespace."""
        more.pop("allow_val_change", None)
        for part in settings:
            self._configure(part)
        self._configure(more)

    def setdefaults(self, settings: Any) -> None:
        """Take the settings that are not there yet."""
        self._configure(settings, is_default=True)

    def as_dict(self) -> Json:
        """Return the settings."""
        return dict(self._script.settings)

    def __getitem__(self, key: str) -> Any:
        return self._script.settings[key]

    def __setitem__(self, key: str, value: object) -> None:
        self._configure({key: value})

    def __delitem__(self, key: str) -> None:
        raise RunnerError(f"config: {key!r} cannot be removed")

    def __iter__(self) -> Iterator[str]:
        return iter(self._script.settings)

    def __len__(self) -> int:
        return len(self._script.settings)

    def __getattr__(self, key: str) -> Any:
        try:
            return self._script.settings[key]
        except KeyError:
            raise AttributeError(f"config has no {key!r}, but {', '.join(self) or 'nothing'}") from None

    __setattr__ = __setitem__


class Summary(Json):
    """The last value logged under each name, and what the script puts there, which is logged at the end."""

    def __init__(self) -> None:
        super().__init__()
        self.own: Json = {}

    def __setitem__(self, key: str, value: object) -> None:
        super().__setitem__(key, value)
        self.own[key] = value

    def update(self, values: Any = (), **more: object) -> None:  # type: ignore[override]
        """Put several values there."""
        for key, value in {**dict(values), **more}.items():
            self[key] = value

    def seen(self, key: str, value: object) -> None:
        """Note a value that was logged."""
        super().__setitem__(key, value)
