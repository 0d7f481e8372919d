"""What `reset` was called with, besides a seed that the record of the reset holds."""

from __future__ import annotations

import json
from typing import Final, NamedTuple

from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.messages import decode, encode
from runner.util.jsonable import is_exact, restored

MAX_DIGITS: Final = 4000
MAX_LARGE_SEED: Final = 10**MAX_DIGITS - 1
"""The largest seed that is recorded."""


class ResetOptions(NamedTuple):
    """The options of a reset, and a seed that is too large for its record."""

    reset: int = -1
    """The number of the reset in its phase, as in `dualtaxi.Reset`."""
    json: str = ""
    """The options as `exact_json` writes them, or as text the reason why they are not recorded; empty for
    none."""
    large_seed: int | None = None
    """The seed, if it has more than 64 bits."""
    resets: int = 1
    """How many consecutive resets have the options: those of one call, which resets several environments."""

    @property
    def options(self) -> dict[str, object] | None:
        """The options; None if there are none, or none that could be recorded."""
        options = restored(json.loads(self.json)) if self.json else None
        return options if isinstance(options, dict) else None

    @property
    def is_exact(self) -> bool:
        """Whether the options are those that the environment got."""
        return is_exact(self.json) and (not self.json or self.options is not None)

    def to_payload(self) -> bytes:
        """Return the message."""
        seed = "" if self.large_seed is None else str(self.large_seed)
        return encode(schema.RESET_OPTIONS, self._asdict() | {"large_seed": seed})


def decode_reset_options(payload: bytes) -> ResetOptions:
    """Return the options in a `dualtaxi.ResetOptions`.

    Raises:
        RecordingError: they are no JSON, or the seed is no number.
    """
    fields = decode(schema.RESET_OPTIONS, payload)
    seed = fields["large_seed"]
    if seed and not (seed.isascii() and seed.isdecimal() and len(seed) <= MAX_DIGITS):
        raise RecordingError(f"found the seed {seed[:40]!r} of a reset, expected at most {MAX_DIGITS} digits")
    large_seed = int(seed) if seed else None
    given = ResetOptions(fields["reset"], fields["json"], large_seed, fields["resets"])
    try:
        given.options  # noqa: B018 - read once, to refuse what is no JSON
    except (ValueError, RecursionError) as error:
        raise RecordingError(f"found options of a reset that are no JSON ({error})") from error
    return given
