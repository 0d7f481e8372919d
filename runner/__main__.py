"""`dualtaxi`, or `python -m runner`: the command line, from its first import on."""

from __future__ import annotations

import sys


def main() -> None:
    """Run the command line; Ctrl-C is told by the exit code alone, also while it is loaded."""
    try:
        from runner.cli import main as command_line

        command_line()
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
