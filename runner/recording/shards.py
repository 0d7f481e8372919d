"""The processes that recorded a run together, as its recording names them once they are folded into it."""

from __future__ import annotations

import json
from typing import Final, NamedTuple

from runner.errors import RecordingError
from runner.recording.maker import MAKER_RECORD
from runner.util.values import is_text, is_whole

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
