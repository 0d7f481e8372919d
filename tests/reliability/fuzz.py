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
import subprocess
import sys
import tempfile
import time
import zlib
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["runner.recording", "runner.environments.mdp"]):
    from runner.recording.repair import repair

from runner.errors import RunnerError
from tests.reliability.hostile import mutate
from tests.reliability.reading import read_everything, small_recordings

MEMORY_MB = 264
SECONDS = 10
ROUND = 100_000
SHARED = Path("/dev/shm")
EVERY_REPAIR = 8
"""Every Nth input is also repaired."""


def main() -> None:
    """Fuzz in rounds, one process each, because the memory of the fuzzer itself grows."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=1_000_000, help="number of inputs")
    parser.add_argument("--seconds", type=int, default=0, help="time limit; 0 for none")
    parser.add_argument("--seed", type=int, default=1, help="seed of libFuzzer")
    parser.add_argument(
        "--findings", type=Path, default=Path("fuzz-findings"), help="folder for failing inputs"
    )
    parser.add_argument("--corpus", type=Path, help=argparse.SUPPRESS)  # of a round
    options = parser.parse_args()
    options.findings.mkdir(parents=True, exist_ok=True)
    if options.corpus:
        fuzz(options)
        return
    begin = time.monotonic()
    with tempfile.TemporaryDirectory(dir=SHARED if SHARED.is_dir() else None) as folder:
        corpus = Path(folder, "corpus")
        corpus.mkdir()
        for name, data in small_recordings(Path(folder, "runs")).items():
            (corpus / name).write_bytes(data)
        for number, done in enumerate(range(0, options.runs, ROUND)):
            left = options.seconds and options.seconds - int(time.monotonic() - begin)
            if left < 0:
                break
            runs = min(ROUND, options.runs - done)
            size = ("--runs", f"{runs}", "--seconds", f"{left}", "--seed", f"{options.seed + number}")
            kept = ("--findings", f"{options.findings}", "--corpus", f"{corpus}")
            command = [sys.executable, "-W", "ignore", "-m", "tests.reliability.fuzz", *size, *kept]
            ended = subprocess.run(command, check=False)
            if ended.returncode:
                sys.exit(f"A finding in round {number + 1}: see above, and {options.findings}.")
            print(f"{done + runs:,} inputs in {time.monotonic() - begin:,.0f} s: no finding", flush=True)


def fuzz(options: argparse.Namespace) -> None:
    """Fuzz for a round; libFuzzer ends the process."""
    path = options.corpus.parent / "input.mcap"

    def try_one(data: bytes) -> None:
        path.write_bytes(data)
        read_everything(path)
        if zlib.crc32(data) % EVERY_REPAIR == 0:
            with contextlib.suppress(RunnerError):
                repair(path)

    def change(data: bytes, max_size: int, seed: int) -> bytes:
        return mutate(data, random.Random(seed), lambda part: atheris.Mutate(part, len(part) + 64))[:max_size]

    for data in sorted(options.corpus.iterdir())[
        :16
    ]:  # what is imported or cached on first use counts as ours
        try_one(data.read_bytes())
    arguments = [
        *(sys.argv[0], str(options.corpus), f"-runs={options.runs}", f"-seed={options.seed}"),
        *(f"-max_total_time={options.seconds}", "-max_len=65536", "-len_control=0"),
        *(f"-rss_limit_mb={_resident_mb() + MEMORY_MB}", f"-timeout={SECONDS}"),
        *(f"-artifact_prefix={options.findings}{os.sep}", "-print_final_stats=1", "-verbosity=1"),
    ]
    atheris.Setup(arguments, try_one, custom_mutator=change)
    atheris.Fuzz()


def _resident_mb() -> int:
    import psutil

    return int(psutil.Process().memory_info().rss >> 20)


if __name__ == "__main__":
    main()
