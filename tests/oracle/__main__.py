"""Compare the content of every kind of recording with the one that is kept; `--write` stores it again.

It is written only when recordings get new content: never because the format changed.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path

from tests.oracle import storing
from tests.oracle.recipes import ALGORITHMS, MORE_ALGORITHMS, contents


def main() -> int:
    """Do what the options say; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--write", action="store_true", help="keep the content of today's recordings")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        os.environ |= {"DUALTAXI_CODE": "off", "XDG_DATA_HOME": folder}
        found = contents(Path(folder, "recordings"), ALGORITHMS | MORE_ALGORITHMS)
    if options.write:
        storing.write(found)
        return 0
    kept = storing.read()
    differ = [
        line
        for run in kept.keys() | found.keys()
        for line in storing.differences(run, kept.get(run, {}), found.get(run, {}))
    ]
    print("\n".join(differ) or "Every recording has the content that it had.")
    return 1 if differ else 0


if __name__ == "__main__":
    sys.exit(main())
