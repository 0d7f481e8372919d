"""What resets depend on: what `reset` was called with, and the random generators of the environment.

The state of the generators is recorded at the first reset without a seed, and then at the first one after
`STEPS_BETWEEN` more steps, so that it costs a step nearly nothing. Any episode can be repeated from the last
recorded state, or the last reset with a seed, at or before its own reset.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from typing import Final, NamedTuple

from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.messages import decode, encode
from runner.util.jsonable import is_exact, restored
from runner.util.values import Json, JsonView

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


STEPS_BETWEEN: Final = 1_000
"""The least steps of an environment from one recorded state to the next."""
SEED_BYTES: Final = 16
MAX_ALE_STATE: Final = 1 << 20
"""The most bytes of an emulator's state."""
_PCG64: Final = struct.Struct("<16s16sII")
"""State, increment, `uinteger`, `has_uint32`."""


class ResetState(NamedTuple):
    """What one reset without a seed depends on.

    To repeat the episode that begins with it, call `reset(seed=np_random_seed)` if that is there; otherwise
    set `bit_generator` and `ale_state`, as far as they are there, and call `reset()`.
    """

    reset: int = -1
    """The number of the reset in its phase, as in `dualtaxi.Reset`."""
    environment: int = 0
    """Which environment of a vector; 0 for a generator that all environments share."""
    np_random_seed: int | None = None
    """The seed of the generator that the reset made, drawn by NumPy; None if it made none."""
    bit_generator: Mapping[str, object] | None = None
    """The state of `unwrapped.np_random` before the reset, as `numpy.random.PCG64.state` takes it."""
    ale_state: bytes = b""
    """The state of an Atari environment's emulator before the reset, as `ale_py.ALEState` takes it, with its
    generator; empty for other environments."""

    @property
    def resets(self) -> int:
        """How many consecutive resets it belongs to: one."""
        return 1

    def to_payload(self) -> bytes:
        """Return the message."""
        seed = self.np_random_seed
        generator = b""
        if self.bit_generator is not None:
            state: JsonView = self.bit_generator
            inner = state["state"]
            numbers = (inner[name].to_bytes(16, "little") for name in ("state", "inc"))
            generator = _PCG64.pack(*numbers, state["uinteger"], state["has_uint32"])
        return encode(
            schema.RESET_STATE,
            {
                "reset": self.reset,
                "environment": self.environment,
                "np_random_seed": b"" if seed is None else seed.to_bytes(SEED_BYTES, "little"),
                "bit_generator": generator,
                "ale_state": self.ale_state,
            },
        )


def decode_reset_state(payload: bytes) -> ResetState:
    """Return the state in a `dualtaxi.ResetState`.

    Raises:
        RecordingError: a value has another size than expected.
    """
    fields = decode(schema.RESET_STATE, payload)
    seed, packed, ale = fields["np_random_seed"], fields["bit_generator"], fields["ale_state"]
    if len(seed) not in (0, SEED_BYTES) or len(packed) not in (0, _PCG64.size) or len(ale) > MAX_ALE_STATE:
        raise RecordingError(
            f"found a reset state with a seed of {len(seed)} bytes, a generator of {len(packed)} and an "
            f"emulator of {len(ale):,}; expected {SEED_BYTES}, {_PCG64.size}, at most {MAX_ALE_STATE:,}"
        )
    generator: Json | None = None
    if packed:
        state, increment, uinteger, has_uint32 = _PCG64.unpack(packed)
        inner = {"state": int.from_bytes(state, "little"), "inc": int.from_bytes(increment, "little")}
        if not inner["inc"] % 2 or has_uint32 > 1:
            raise RecordingError("found the state of a random generator that no PCG64 has")
        generator = {"bit_generator": "PCG64", "state": inner, "has_uint32": has_uint32, "uinteger": uinteger}
    return ResetState(
        reset=fields["reset"],
        environment=fields["environment"],
        np_random_seed=int.from_bytes(seed, "little") if seed else None,
        bit_generator=generator,
        ale_state=ale,
    )
