"""Single bytes changed anywhere in a recording: `python -m tests.reliability.damage [--changes N]`.

Each change is one byte, anywhere in a small recording, to any other value; `verify` must find it. The one
thing that may read otherwise without being wrong is the text that says which version of the program wrote
the file; a change there is found as well, by the checksum of the data section.
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
import time
from pathlib import Path

from runner.errors import RunnerError
from runner.execution.verify import verify
from tests.reliability.reading import small_recordings


def main() -> int:
    """Change bytes; return 1 if one change was not found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--changes", type=int, default=10_000, help="how many")
    parser.add_argument("--seed", type=int, default=1, help="fixes all of them")
    options = parser.parse_args()
    begun = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        missed = changes_not_found(Path(folder), options.changes, options.seed)
    print(f"seed {options.seed}: {options.changes} changed bytes, {len(missed)} not found by verify", end="")
    print(f"; {time.monotonic() - begun:.0f} s", *missed, sep="\n")
    return 1 if missed else 0


def changes_not_found(folder: Path, changes: int, seed: int) -> list[str]:
    """Return the changes of single bytes in finished recordings that `verify` does not find."""
    rng = random.Random(seed)
    whole = {name: data for name, data in small_recordings(folder).items() if not name.endswith("-cut")}
    path, missed = folder / "changed.mcap", []
    for name, data in whole.items():
        path.write_bytes(data)
        assert verify(path).sound, name
    for _ in range(changes):
        name = rng.choice(sorted(whole))
        data = bytearray(whole[name])
        place = rng.randrange(len(data))
        before = data[place]
        data[place] ^= rng.randrange(1, 256)
        path.write_bytes(data)
        if is_sound(path):
            missed.append(f"{name}: byte {place} of {len(data)} from {before} to {data[place]}")
    return missed


def is_sound(path: Path) -> bool:
    """Return whether verify finds nothing; a file that it refuses to take for a recording is not sound."""
    try:
        return verify(path).sound
    except RunnerError:
        return False


if __name__ == "__main__":
    sys.exit(main())
