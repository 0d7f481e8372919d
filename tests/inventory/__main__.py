"""Compare all that a user can see or read by a program with the inventory.

`python -m tests.inventory` names what is missing and what is new, and ends with exit code 1 if anything is;
`--write` adds what is new, and removes what gone.txt names;
`--screenshots FOLDER` takes pictures of every page.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from runner.service.processes import PRELOADED
from runner.util.processes import process_context
from tests.browsing import chromium
from tests.inventory.comparing import ADVICE, differences, gone_pattern, read, write
from tests.inventory.taking import FILES, Shop, screenshots


def main() -> int:
    """Do what the options say; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--write", action="store_true", help="write the inventory")
    parser.add_argument("--screenshots", type=Path, metavar="FOLDER", help="write pictures of every page")
    options = parser.parse_args()
    process_context(PRELOADED)  # as the service does it; else each child of a command imports them itself
    problems, gone = [], gone_pattern()
    with tempfile.TemporaryDirectory() as folder, Shop(Path(folder)) as shop, chromium() as browser:
        if options.screenshots:
            screenshots(shop, browser, options.screenshots)
            return 0
        for name, take in FILES.items():
            found = take(shop, browser)
            if options.write:
                write(name, found, gone)
            problems += differences(read(name), found, gone)
    print("\n".join([*problems, ADVICE] if problems else ["Nothing is missing, and nothing is new."]))
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
