"""How a loop's environment was made, so that it can be made again: stored in its recording, read with checks.

Nothing here imports or makes an environment.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

from runner.errors import RecordingError
from runner.util.values import MAX_TEXT, is_text, is_too_deep, is_whole

MAKER_RECORD: Final = "environment_maker"
"""The metadata record with the maker, as JSON."""
KINDS: Final = ("gymnasium", "vector", "pettingzoo")
MODES: Final = ("sync", "async", "custom")
AUTORESET_MODES: Final = ("NextStep", "SameStep", "Disabled")
MODULE_NAME: Final = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*")
FUNCTION_NAME: Final = re.compile(rf"{MODULE_NAME.pattern}:{MODULE_NAME.pattern}")
"""`module:function`, such as `train.envs:make_env`."""
MAX_SPEC: Final = 1 << 20
"""The most characters of a specification."""
MAX_NAMES: Final = 100
"""The most wrappers, packages and names of actions."""
_MAX_REASON: Final = 2_000
_MAX_ENVIRONMENTS: Final = 10**7 - 1


@dataclass(frozen=True)
class VectorMaker:
    """How environments were put together to a vector."""

    number: int
    mode: str
    """`sync`: a `SyncVectorEnv`, `async`: an `AsyncVectorEnv`, `custom`: another class."""
    autoreset: str
    """The value of its `AutoresetMode`: `NextStep`, `SameStep` or `Disabled`."""
    wrappers: tuple[str, ...] = ()
    """The wrappers of the vector, `module:class`, from the outermost in."""
    wrapper_specs: str = "[]"
    """JSON: a list of the same as Gymnasium's `WrapperSpec` (`name`, `entry_point`, `kwargs`), from the
    innermost out."""
    library: str = ""
    """`stable-baselines3` if it was a `VecEnv` of that library, whose episodes are not recorded as truncated
    if they terminated; `make` then makes one of its environments."""

    @property
    def is_vec_env(self) -> bool:
        """Whether it was a `VecEnv` of Stable-Baselines3."""
        return self.library == "stable-baselines3"


@dataclass(frozen=True)
class EnvironmentMaker:
    """How an environment was made.

    `reason` is empty if `spec` is complete: `gymnasium.make(EnvSpec.from_json(spec))` gives the environment
    with all wrappers. For a vector of mode `sync` or `async` it gives one of the environments; for one of
    mode `custom`, `gymnasium.make_vec` takes it.
    """

    kind: str
    """`gymnasium`, `vector`, or `pettingzoo` for games of several agents, those of RLlib too."""
    spec: str = ""
    """JSON: of Gymnasium's `EnvSpec`; of a game `{"entry_point": "module:function", "kwargs": {...}}`.

    Empty if it is unknown.
    """
    registered_by: str = ""
    """The module whose import registers the environment, such as `ale_py`; empty if none is needed."""
    make: str = ""
    """The function that the user named, `module:function`: it returns the environment, or the vector or game,
    without arguments, and is used instead of `spec`; empty if none."""
    reason: str = ""
    """Why `spec` does not suffice to make the environment; empty if it does."""
    wrappers: tuple[str, ...] = ()
    """The wrappers of an environment, `module:class`, from the outermost in."""
    assumed: tuple[str, ...] = ()
    """The wrappers, environments or games, `module:class`, whose arguments are not known for certain: `spec`
    has those of their attributes, or the default values."""
    inner_wrappers: int = 0
    """How many wrappers the registered function adds itself, which are not in `spec`."""
    registered: Mapping[str, Any] = field(default_factory=dict)
    """`kwargs` and `max_episode_steps` that are registered for the id; empty if it is not registered."""
    vector: VectorMaker | None = None
    packages: Mapping[str, str] = field(default_factory=dict)
    """The versions of the distributions that determine what the environment does, by name."""
    platform: str = ""
    machine: str = ""
    action_names: tuple[str, ...] = ()
    """The names of the actions of a `Discrete` space, the least action's first; empty if unknown."""
    agent_action_names: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """The same for each agent of a game; agents without names are left out."""

    def is_like(self, other: EnvironmentMaker) -> bool:
        """Return whether another maker makes the environment, or each of a vector, in the same way."""
        names = ("spec", "registered_by", "make", "reason", "wrappers", "assumed", "inner_wrappers")
        return all(getattr(self, name) == getattr(other, name) for name in names)

    def to_metadata(self) -> dict[str, str]:
        """Return the entries of the metadata record."""
        vector = None if self.vector is None else vars(self.vector)
        return {"json": json.dumps(vars(self) | {"vector": vector}, sort_keys=True)}


def parse_maker(values: Mapping[str, object], where: str) -> EnvironmentMaker:
    """Return the maker in a metadata record."""
    check = _Check(values, f"{where}: its {MAKER_RECORD}")
    vector = values.get("vector")
    return EnvironmentMaker(
        kind=check.choice("kind", KINDS),
        spec=check.json("spec", dict),
        registered_by=check.text("registered_by", MAX_TEXT, MODULE_NAME),
        make=check.text("make", MAX_TEXT, FUNCTION_NAME),
        reason=check.text("reason", _MAX_REASON),
        wrappers=check.names("wrappers"),
        assumed=check.names("assumed"),
        inner_wrappers=check.whole("inner_wrappers"),
        registered=check.object("registered"),
        vector=None if vector is None else _parse_vector(vector, f"{where}: the vector's {MAKER_RECORD}"),
        packages=check.versions("packages"),
        platform=check.text("platform", MAX_TEXT),
        machine=check.text("machine", MAX_TEXT),
        action_names=check.labels("action_names"),
        agent_action_names=check.labels_by_name("agent_action_names"),
    )


def _parse_vector(values: object, where: str) -> VectorMaker:
    check = _Check(values, where)
    number = check.values.get("number")
    check.require("number", is_whole(number, 1, _MAX_ENVIRONMENTS))
    return VectorMaker(
        number=int(check.values["number"]),
        mode=check.choice("mode", MODES),
        autoreset=check.choice("autoreset", AUTORESET_MODES),
        wrappers=check.names("wrappers"),
        wrapper_specs=check.json("wrapper_specs", list),
        library=check.text("library", MAX_TEXT) if "library" in check.values else "",
    )


class _Check:
    """Returns the values of a JSON object, each after a check of its type and size."""

    def __init__(self, values: object, where: str) -> None:
        if not isinstance(values, Mapping):
            raise RecordingError(f"{where} is damaged: found {type(values).__name__}, expected an object.")
        self.values = values
        self._where = where

    def require(self, key: str, is_valid: bool) -> None:
        if not is_valid:
            found = repr(self.values.get(key))[:MAX_TEXT]
            raise RecordingError(f"{self._where} is damaged: found {key} {found}.")

    def text(self, key: str, limit: int, pattern: re.Pattern[str] | None = None) -> str:
        value = self.values.get(key)
        is_valid = isinstance(value, str) and len(value) <= limit
        self.require(key, is_valid and (not value or pattern is None or bool(pattern.fullmatch(str(value)))))
        return str(value)

    def json(self, key: str, kind: type) -> str:
        """Return a text that is empty, or holds JSON of this kind that is not nested too deeply."""
        text = self.text(key, MAX_SPEC)
        try:
            value = json.loads(text) if text else kind()
        except (ValueError, RecursionError):
            value = None
        self.require(key, isinstance(value, kind) and not is_too_deep(value))
        return text

    def object(self, key: str) -> Mapping[str, Any]:
        """Return an object of bounded size; an empty one if it is missing, as in earlier recordings."""
        value = self.values.get(key, {})
        self.require(key, isinstance(value, Mapping) and not is_too_deep(value))
        self.require(key, isinstance(value.get("kwargs", {}), Mapping))
        limit = value.get("max_episode_steps")
        self.require(key, limit is None or is_whole(limit, 1, 2**62))
        return dict(value)

    def whole(self, key: str) -> int:
        """Return a number from 0; 0 if it is missing, as in earlier recordings."""
        value = self.values.get(key, 0)
        self.require(key, is_whole(value, 0, MAX_NAMES))
        return int(value)

    def choice(self, key: str, choices: tuple[str, ...]) -> str:
        self.require(key, self.values.get(key) in choices)
        return str(self.values[key])

    def names(self, key: str) -> tuple[str, ...]:
        value = self.values.get(key)
        self.require(key, isinstance(value, list) and len(value) <= MAX_NAMES)
        names = tuple(self.values[key])
        self.require(key, all(isinstance(name, str) and len(name) <= MAX_TEXT for name in names))
        return names

    def labels(self, key: str) -> tuple[str, ...]:
        """Return texts that can be shown anywhere; none if the key is missing, as in earlier recordings."""
        labels = self.names(key) if key in self.values else ()
        self.require(key, all(map(is_text, labels)))
        return labels

    def labels_by_name(self, key: str) -> dict[str, tuple[str, ...]]:
        """Return such texts of an object by key; none if the object is missing, as in earlier recordings."""
        by_name = self.values.get(key, {})
        self.require(key, isinstance(by_name, Mapping) and len(by_name) <= MAX_NAMES)
        own = _Check(by_name, self._where)
        return {name: own.labels(name) for name in by_name}

    def versions(self, key: str) -> dict[str, str]:
        value = self.values.get(key)
        self.require(key, isinstance(value, Mapping) and len(value) <= MAX_NAMES)
        versions = dict(self.values[key])
        texts = [text for pair in versions.items() for text in pair]
        self.require(key, all(isinstance(text, str) and len(text) <= MAX_TEXT for text in texts))
        return versions


SHARD_MAKER: Final = f"{MAKER_RECORD}/shard"
"""The metadata record, with the shard's name after it, of how its environments were made, if otherwise."""
_MAX_SHARDS: Final = 10_000
_MAX_NAME: Final = 100


class Shard(NamedTuple):
    """A process, and how much of a run it recorded."""

    name: str
    """Empty for the process that began the run."""
    environments: int
    """How many environments it stepped."""
    status: str
    """How it ended: `finished`, `failed` or `interrupted`."""
    train_steps: int
    eval_steps: int


def parse_shards(text: str | None, where: str) -> tuple[Shard, ...]:
    """Return the shards in a metadata record `run`; none for a run of one process.

    Raises:
        RecordingError: they are damaged.
    """
    if text is None:
        return ()
    try:
        shards = tuple(Shard(**shard) for shard in json.loads(text))
    except (ValueError, TypeError, RecursionError) as error:
        raise RecordingError(f"{where}: its shards are damaged ({error}).") from error
    for shard in shards:
        counts = shard.train_steps, shard.eval_steps
        is_named = shard.name == "" or (is_text(shard.name) and len(shard.name) <= _MAX_NAME)
        is_counted = is_whole(shard.environments, 1, 10**7 - 1) and all(is_whole(n, 0, 2**62) for n in counts)
        if not (is_named and is_text(shard.status) and is_counted):
            raise RecordingError(f"{where}: its shards are damaged: found {str(tuple(shard))[:200]}.")
    if not 0 < len(shards) <= _MAX_SHARDS:
        raise RecordingError(f"{where}: its shards are damaged: found {len(shards)} of them.")
    return shards
