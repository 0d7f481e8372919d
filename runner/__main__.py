"""`dualtaxi`, or `python -m runner`: the entry point of the command line."""

from __future__ import annotations

import sys


def main() -> None:
    """Run the command line; Ctrl-C only sets the exit code, even while modules are imported."""
    try:
        from runner.cli import main as command_line

        command_line()
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
