"""Compare all that a user can see or read by a program with the inventory.

`python -m tests.inventory` names what is missing and what is new, and ends with exit code 1 if anything is;
`--write` takes the inventory; `--screenshots FOLDER` takes pictures of every page.
"""

from __future__ import annotations

import argparse
import fnmatch
import os
import sys
import tempfile
from pathlib import Path

from tests.inventory.reading import differences, read, write
from tests.inventory.taking import FILES, Shop, chromium, screenshots

HERE = Path(__file__).parent
GONE = HERE / "gone.txt"
"""Patterns `NAME: LINE` of what was removed on purpose, each below a comment that says why."""


def main() -> int:
    """Do what the options say; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--write", action="store_true", help="write the inventory")
    parser.add_argument("--screenshots", type=Path, metavar="FOLDER", help="write pictures of every page")
    options = parser.parse_args()
    os.environ |= {"DUALTAXI_CODE": "off", "MUJOCO_GL": "egl"}
    with tempfile.TemporaryDirectory() as folder:
        for name in ("XDG_CACHE_HOME", "XDG_DATA_HOME", "XDG_CONFIG_HOME", "XDG_STATE_HOME"):
            os.environ[name] = f"{folder}/{name}"
        with Shop(Path(folder) / "shop") as shop, chromium() as browser:
            if options.screenshots:
                screenshots(shop, browser, options.screenshots)
                return 0
            found = []
            for name, take in FILES.items():
                inventory = take(shop, browser)
                if options.write:
                    write(HERE / name, inventory)
                else:
                    found += differences(read(HERE / name), inventory, is_gone)
    print("\n".join(found) or "Nothing is missing, and nothing is new.")
    return 1 if found else 0


def is_gone(name: str, line: str) -> bool:
    """Return whether a line may be missing."""
    patterns = [text for text in GONE.read_text(encoding="utf-8").splitlines() if text and text[0] != "#"]
    return any(fnmatch.fnmatchcase(f"{name}: {line}", pattern) for pattern in patterns)


if __name__ == "__main__":
    sys.exit(main())
