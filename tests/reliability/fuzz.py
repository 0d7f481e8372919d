"""Coverage-guided fuzzing of the reader: `python -m tests.reliability.fuzz [--runs N] [--seed S]`.

libFuzzer (by Atheris) keeps the inputs that reach code which none before reached, and changes those;
`hostile` changes them by their meaning. A finding is anything but one of the project's errors: another
exception, an input that takes more than 10 seconds, or more than 264 MB of memory (200 MB and a chunk).
Ends with exit code 0 if there was none; else the input is kept and its name printed.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import sys
import tempfile
import zlib
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["runner.recording", "runner.mdp"]):
    from runner.recording.repair import repair

from runner.errors import RunnerError
from tests.reliability.hostile import mutate
from tests.reliability.reading import read_everything, small_recordings

MEMORY_MB = 264
SECONDS = 10
EVERY_REPAIR = 8
"""One of so many inputs is repaired besides."""


def main() -> None:
    """Fuzz; libFuzzer ends the process."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=1_000_000, help="inputs to try")
    parser.add_argument("--seconds", type=int, default=0, help="stop after so long; 0 for never")
    parser.add_argument("--seed", type=int, default=1, help="of libFuzzer; the same seed tries the same")
    parser.add_argument("--findings", type=Path, default=Path("fuzz-findings"), help="where they are kept")
    options = parser.parse_args()
    options.findings.mkdir(parents=True, exist_ok=True)
    shared = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=shared if shared.is_dir() else None) as folder:
        corpus = Path(folder, "corpus")
        corpus.mkdir()
        for name, data in small_recordings(Path(folder, "runs")).items():
            (corpus / name).write_bytes(data)
        path = Path(folder, "input.mcap")

        def try_one(data: bytes) -> None:
            path.write_bytes(data)
            read_everything(path)
            if zlib.crc32(data) % EVERY_REPAIR == 0:
                with contextlib.suppress(RunnerError):
                    repair(path)

        def change(data: bytes, max_size: int, seed: int) -> bytes:
            return mutate(data, random.Random(seed), lambda part: atheris.Mutate(part, len(part) + 64))[
                :max_size
            ]

        for data in corpus.iterdir():  # all that is imported or cached on first use counts as ours
            try_one(data.read_bytes())
        arguments = [
            *(sys.argv[0], str(corpus), f"-runs={options.runs}", f"-seed={options.seed}"),
            *(f"-max_total_time={options.seconds}", "-max_len=65536", "-len_control=0"),
            *(f"-rss_limit_mb={_resident_mb() + MEMORY_MB}", f"-timeout={SECONDS}"),
            *(f"-artifact_prefix={options.findings}{os.sep}", "-print_final_stats=1"),
        ]
        atheris.Setup(arguments, try_one, custom_mutator=change)
        atheris.Fuzz()


def _resident_mb() -> int:
    import psutil

    return int(psutil.Process().memory_info().rss >> 20)


if __name__ == "__main__":
    main()
