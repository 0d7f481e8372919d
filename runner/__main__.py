"""`dualtaxi`, or `python -m runner`: the entry point of the command line."""

from __future__ import annotations

import gc
import os
import sys
from pathlib import Path

gc.set_threshold(50_000)  # imports create many objects that stay: search them less often than at 700


def main() -> None:
    """Run the command line; Ctrl-C only sets the exit code, even while modules are imported."""
    os.environ.setdefault("PYTHONSAFEPATH", "1")  # no child imports from the current folder
    try:
        from runner.cli import main as command_line

        command_line()
    except KeyboardInterrupt:
        sys.exit(130)
    finally:
        if "duckdb" not in sys.modules:  # it complains of objects that are not collected
            gc.freeze()  # else Python searches all objects again when it ends, which takes up to 0.15 s


if __name__ == "__main__":
    if not sys.flags.safe_path and sys.path[0] != str(Path(__file__).parents[1]):
        del sys.path[0]  # the current folder, which `python -m` puts there
    main()
