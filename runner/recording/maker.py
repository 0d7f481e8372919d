"""How a loop's environment was made, so that it can be made again: stored in its recording, read with checks.

Nothing here imports or makes an environment.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import chain
from typing import Annotated, Any, Final, Literal, TypedDict

from msgspec import Meta

from runner.errors import RecordingError
from runner.util.stored import Count, Text, require_keys, stored_as
from runner.util.values import MAX_TEXT, is_text, is_too_deep

MAKER_RECORD: Final = "environment_maker"
"""The metadata record with the maker, as JSON."""
MODULE_NAME: Final = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*")
FUNCTION_NAME: Final = re.compile(rf"{MODULE_NAME.pattern}:{MODULE_NAME.pattern}")
"""`module:function`, such as `train.envs:make_env`."""
MAX_SPEC: Final = 1 << 20
"""The most characters of a specification."""
MAX_NAMES: Final = 100
"""The most wrappers, packages and names of actions."""
_MAX_NAME: Final = 100
_MAX_SHARDS: Final = 10_000
_Environments = Annotated[int, Meta(ge=1, le=10**7 - 1)]
_Spec = Annotated[str, Meta(max_length=MAX_SPEC)]
_Names = Annotated[tuple[Text, ...], Meta(max_length=MAX_NAMES)]


@dataclass(frozen=True)
class VectorMaker:
    """How environments were put together to a vector."""

    number: _Environments
    mode: Annotated[str, Meta(pattern=r"^(sync|async|custom)\Z")]
    """`sync`: a `SyncVectorEnv`, `async`: an `AsyncVectorEnv`, `custom`: another class."""
    autoreset: Literal["NextStep", "SameStep", "Disabled"]
    """The value of its `AutoresetMode`: `NextStep`, `SameStep` or `Disabled`."""
    wrappers: _Names = ()
    """The wrappers of the vector, `module:class`, from the outermost in."""
    wrapper_specs: _Spec = "[]"
    """JSON: a list of the same as Gymnasium's `WrapperSpec` (`name`, `entry_point`, `kwargs`), from the
    innermost out."""
    library: Text = ""
    """`stable-baselines3` if it was a `VecEnv` of that library, whose episodes are not recorded as truncated
    if they terminated; `make` then makes one of its environments."""

    @property
    def is_vec_env(self) -> bool:
        """Whether it was a `VecEnv` of Stable-Baselines3."""
        return self.library == "stable-baselines3"


class Registered(TypedDict, total=False):
    """What is registered for the id of an environment."""

    kwargs: Mapping[str, Any]
    max_episode_steps: Annotated[int, Meta(ge=1, le=2**62)] | None


@dataclass(frozen=True)
class EnvironmentMaker:
    """How an environment was made.

    `reason` is empty if `spec` is complete: `gymnasium.make(EnvSpec.from_json(spec))` gives the environment
    with all wrappers. For a vector of mode `sync` or `async` it gives one of the environments; for one of
    mode `custom`, `gymnasium.make_vec` takes it.
    """

    kind: Literal["gymnasium", "vector", "pettingzoo"]
    """`gymnasium`, `vector`, or `pettingzoo` for games of several agents, those of RLlib too."""
    spec: _Spec = ""
    """JSON: of Gymnasium's `EnvSpec`; of a game `{"entry_point": "module:function", "kwargs": {...}}`.

    Empty if it is unknown.
    """
    registered_by: Annotated[Text, Meta(pattern=rf"^({MODULE_NAME.pattern})?\Z")] = ""
    """The module whose import registers the environment, such as `ale_py`; empty if none is needed."""
    make: Annotated[Text, Meta(pattern=rf"^({FUNCTION_NAME.pattern})?\Z")] = ""
    """The function that the user named, `module:function`: it returns the environment, or the vector or game,
    without arguments, and is used instead of `spec`; empty if none."""
    reason: Annotated[str, Meta(max_length=2_000)] = ""
    """Why `spec` does not suffice to make the environment; empty if it does."""
    wrappers: _Names = ()
    """The wrappers of an environment, `module:class`, from the outermost in."""
    assumed: _Names = ()
    """The wrappers, environments or games, `module:class`, whose arguments are not known for certain: `spec`
    has those of their attributes, or the default values."""
    inner_wrappers: Annotated[int, Meta(ge=0, le=MAX_NAMES)] = 0
    """How many wrappers the registered function adds itself, which are not in `spec`."""
    registered: Registered = field(default_factory=Registered)
    """`kwargs` and `max_episode_steps` that are registered for the id; empty if it is not registered."""
    vector: VectorMaker | None = None
    packages: Annotated[Mapping[Text, Text], Meta(max_length=MAX_NAMES)] = field(default_factory=dict)
    """The versions of the distributions that determine what the environment does, by name."""
    platform: Text = ""
    machine: Text = ""
    action_names: _Names = ()
    """The names of the actions of a `Discrete` space, the least action's first; empty if unknown."""
    agent_action_names: Annotated[Mapping[str, _Names], Meta(max_length=MAX_NAMES)] = field(
        default_factory=dict
    )
    """The same for each agent of a game; agents without names are left out."""

    def is_like(self, other: EnvironmentMaker) -> bool:
        """Return whether another maker makes the environment, or each of a vector, in the same way."""
        names = ("spec", "registered_by", "make", "reason", "wrappers", "assumed", "inner_wrappers")
        return all(getattr(self, name) == getattr(other, name) for name in names)

    def to_metadata(self) -> dict[str, str]:
        """Return the entries of the metadata record."""
        vector = None if self.vector is None else vars(self.vector)
        return {"json": json.dumps(vars(self) | {"vector": vector}, sort_keys=True)}


_KEYS: Final = (
    "spec",
    "registered_by",
    "make",
    "reason",
    "wrappers",
    "assumed",
    "packages",
    "platform",
    "machine",
)
"""What every maker's record states, be it empty."""


def parse_maker(values: Mapping[str, object], where: str) -> EnvironmentMaker:
    """Return the maker in a metadata record.

    Raises:
        RecordingError: it is damaged.
    """
    where = f"{where}: its {MAKER_RECORD} is damaged"
    require_keys(values, _KEYS, where)
    maker = stored_as(EnvironmentMaker, values, where)
    if maker.vector is not None and isinstance(vector := values["vector"], Mapping):
        require_keys(vector, ("wrappers", "wrapper_specs"), f"{where}, its vector")
    for text, kind in ((maker.spec, dict), (maker.vector.wrapper_specs if maker.vector else "", list)):
        try:
            specification = json.loads(text) if text else kind()
        except (ValueError, RecursionError):
            specification = None
        if not isinstance(specification, kind) or is_too_deep(specification):
            raise RecordingError(f"{where}: found {text[:MAX_TEXT]!r}, expected a specification as JSON.")
    for label in chain(maker.action_names, *maker.agent_action_names.values()):
        if not is_text(label):
            raise RecordingError(f"{where}: found {label!r}, expected the name of an action.")
    return maker


SHARD_MAKER: Final = f"{MAKER_RECORD}/shard"
"""The metadata record, with the shard's name after it, of how its environments were made, if otherwise."""


@dataclass(frozen=True)
class Shard:
    """A process, and how much of a run it recorded."""

    name: Annotated[str, Meta(max_length=_MAX_NAME)]
    """Empty for the process that began the run."""
    environments: _Environments
    """How many environments it stepped."""
    status: Text
    """How it ended: `finished`, `failed` or `interrupted`."""
    train_steps: Count
    eval_steps: Count


_Shards = Annotated[tuple[Shard, ...], Meta(min_length=1, max_length=_MAX_SHARDS)]


def parse_shards(text: str | None, where: str) -> tuple[Shard, ...]:
    """Return the shards in a metadata record `run`; none for a run of one process.

    Raises:
        RecordingError: they are damaged.
    """
    if text is None:
        return ()
    where = f"{where}: its shards are damaged"
    try:
        values = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise RecordingError(f"{where} ({error}).") from error
    shards = stored_as(_Shards, values, where)
    if unknown := [key for shard in values for key in shard if key not in Shard.__dataclass_fields__]:
        raise RecordingError(f"{where}: found the unknown key {unknown[0][:_MAX_NAME]!r}.")
    for shard in shards:
        if not (is_text(shard.status) and is_text(shard.name or "-")):
            raise RecordingError(f"{where}: found {str(shard)[:200]}.")
    return shards
