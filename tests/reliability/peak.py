"""How much memory it takes to read files in every way: `python -m tests.reliability.peak FILE ...` (Linux).

Prints seconds and megabytes for each file, read in a process of its own that begins with everything imported.
Without arguments, the files are named by lines of the standard input.
"""

from __future__ import annotations

import os
import re
import sys
import time
from pathlib import Path

from tests.reliability.reading import read_everything


def main() -> None:
    """Read each file in a forked process."""
    for path in sys.argv[1:] or map(str.strip, sys.stdin):
        child = os.fork()
        if child == 0:
            code = 1
            try:
                before, begun = peak_bytes(), time.monotonic()
                read_everything(Path(path))
                print(f"{time.monotonic() - begun:.1f} {(peak_bytes() - before) / 1e6:.1f}", flush=True)
                code = 0
            finally:
                os._exit(code)
        if os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]):
            sys.exit(1)


def peak_bytes() -> int:
    """Return the most memory that was resident in this process, since it was forked."""
    found = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    assert found is not None
    return int(found[1]) * 1024


if __name__ == "__main__":
    main()
