"""The command line: parse, call one function, render, exit.

A command is imported when it is invoked, and imports what is heavy when it needs it, so that help and
completion are there at once. `COMMANDS` says where each one is and what it is for.
"""

from __future__ import annotations

import contextlib
import errno
import importlib
import json
import os
import sys
from collections.abc import Sequence
from typing import Any, Final

import click

from runner.errors import ConfigError, ExitCode, Located, RunnerError, StorageError, nearest
from runner.util.version import __version__

COMMANDS: Final[dict[str, dict[str, str]]] = {
    "Run": {
        "run": "Train, evaluate and record an experiment.",
        "sweep": "Run an experiment with many values, and rank them.",
        "resume": "Resume an interrupted run, to the same content as an undisturbed one.",
        "evaluate": "Evaluate a run's Q-table at any step in new episodes.",
        "rerecord": "Record the steps of a run that was recorded without them.",
    },
    "Inspect": {
        "ls": "List the recorded runs.",
        "show": "Show a run: evaluations, tables, configuration.",
        "play": "Replay a recorded episode in the terminal.",
        "view": "Open runs in the Rerun viewer.",
        "plot": "Draw every metric of one or several runs over episodes.",
        "report": "Write one self-contained page about one or several runs.",
        "diff": "Show what differs between two runs, and where they diverge.",
        "compare": "Compare groups of runs, with statistics over seeds.",
        "verify": "Check every step of a run by training it again.",
        "qtable": "Show the exact Q-table of a run at any step.",
        "table": "Print an environment's transition table with names.",
    },
    "Manage": {
        "label": "Change the name, note and tags of a run.",
        "rm": "Remove runs.",
        "prune": "Remove old, unfinished or unwanted runs.",
        "du": "Show what uses disk space, and what could be freed.",
        "repair": "Repair a damaged recording, and report what was lost.",
        "index": "Rebuild the index of runs.",
        "init": "Create a folder to start in, with the shipped experiments.",
        "config": "List, copy and check configurations; print their schema.",
        "completion": "Print the completion script of a shell.",
    },
    "Archive": {
        "archive": "Archive runs as Parquet files, losslessly.",
        "restore": "Restore the recording of an archived run.",
    },
    "Share": {
        "export": "Export a run for other programs.",
        "import": "Import a recording into the folder of runs.",
        "remote": "Upload and download runs; submit and control jobs.",
        "serve": "Serve the runs to browsers and programs over HTTP.",
        "token": "Create, list and revoke access tokens of a server.",
    },
}
"""Section -> command -> its short help."""

_DISK_FULL: Final = tuple(getattr(errno, name) for name in ("ENOSPC", "EDQUOT") if hasattr(errno, name))

_WRONG_PLACE: Final = (
    errno.ENOENT,
    errno.ENOTDIR,
    errno.EISDIR,
    errno.EEXIST,
    errno.EACCES,
    errno.EPERM,
    errno.EROFS,
    errno.ENAMETOOLONG,
    errno.ELOOP,
)
"""Of errors in writing: the place was the wrong one, not the disk full or broken."""
_AS_JSON: Final = "runner.as_json"

_EPILOG = f"""\b
First steps:
  dualtaxi run quick        learn for a second, recording every step
  dualtaxi show @latest     evaluations, tables and configuration of that run
  dualtaxi play @latest     watch an episode of it
  dualtaxi init             copy the shipped experiments into this folder

\b
A RUN is named by its id, a prefix of it, its name, a path, or @latest
(NAME@latest: the newest of that name). Runs are kept in the folder given by
--recordings, else by $DUALTAXI_RECORDINGS, else in ./recordings.

\b
Results go to stdout, everything else to stderr; NO_COLOR is respected.
With --json an error is an object in the last line of stderr:
  {{"error": {{"message": "...", "exit_code": 2, "problems": [...]}}}}
Exit codes:
{chr(10).join(f"  {code:<4} {code.explanation}" for code in ExitCode)}
"""


class Failure(click.ClickException):
    """A `RunnerError`, printed without a traceback."""

    def __init__(self, error: RunnerError) -> None:
        super().__init__("\n".join([str(error), *getattr(error, "__notes__", [])]))
        self.exit_code = exit_code_of(error)  # type: ignore[misc]  # Click's own classes do so
        self.problems = error.problems if isinstance(error, ConfigError) else ()

    def show(self, file: Any = None) -> None:
        """Print the message; of several problems each has a line, which begins with its place."""
        lines = self.message.count("\n") + 1
        head = f"{lines} problems\n" if self.problems and lines > 1 else ""
        click.echo(f"Error: {head}{self.message}", file=file or sys.stderr)


def exit_code_of(error: RunnerError) -> int:
    """Return the exit code for an error: 2 if a place that the user named cannot be written."""
    cause = error.__cause__
    if isinstance(error, StorageError) and isinstance(cause, OSError) and cause.errno in _WRONG_PLACE:
        return RunnerError.exit_code
    return error.exit_code


class JsonFailure(click.ClickException):
    """An error of a command with --json: one line of JSON on stderr."""

    def __init__(self, error: click.ClickException) -> None:
        super().__init__(error.format_message())
        self.exit_code = error.exit_code  # type: ignore[misc]  # Click's own classes do so
        self.problems = getattr(error, "problems", ())

    def show(self, file: Any = None) -> None:
        """Print the object."""
        click.echo(error_as_json(self.message, self.exit_code, self.problems), file=file or sys.stderr)


def error_as_json(message: str, exit_code: int, problems: Sequence[Located] = (), **more: str) -> str:
    """Return an error as a line of JSON, in the form of the service's API.

    Args:
        message: as it is printed without --json.
        exit_code: of the command.
        problems: of a configuration, one by one.
        more: what else is known of it.
    """
    located = [
        {"path": each.path, "line": each.line, "column": each.column, "message": each.message}
        for each in problems
    ]
    return json.dumps({"error": {"message": message, "exit_code": exit_code, **more, "problems": located}})


class Group(click.Group):
    """A group of commands that suggests the nearest name for an unknown one."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find a command, or suggest one."""
        known = self.list_commands(ctx)
        if args[0] not in known and not args[0].startswith("-") and not ctx.resilient_parsing:
            ctx.fail(f"there is no command {args[0]!r}.{nearest(args[0], known)}")
        return super().resolve_command(ctx, args)


class LazyGroup(Group):
    """The commands of `COMMANDS`, imported one by one when asked for."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002
        """Return the names, section by section."""
        return [name for section in COMMANDS.values() for name in section]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import a command."""
        if cmd_name not in self.list_commands(ctx):
            return None
        module = "import_" if cmd_name == "import" else cmd_name
        command: click.Command = importlib.import_module(f"runner.cli.commands.{module}").command
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the sections of commands, from their short help alone."""
        width = max(len(name) for name in self.list_commands(ctx))
        for title, section in COMMANDS.items():
            with formatter.section(title):
                formatter.write_dl([(f"{name:{width}}", text) for name, text in section.items()])

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; what a user can mend, or wanted, is no traceback."""
        try:
            result = self._invoke(ctx)
            sys.stdout.flush()
        except (KeyboardInterrupt, click.Abort):
            raise click.exceptions.Exit(ExitCode.INTERRUPTED) from None
        except BrokenPipeError:
            _forget_stdout()
            raise click.exceptions.Exit(ExitCode.OK) from None
        except OSError as error:
            if error.errno not in _DISK_FULL:
                raise
            raise Failure(StorageError(f"{error.filename or 'stdout'}: {error.strerror}.")) from error
        return result

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Remember whether the command is to print JSON, before anything of it is parsed."""
        ctx.meta[_AS_JSON] = "--json" in args
        return super().parse_args(ctx, args)

    def _invoke(self, ctx: click.Context) -> Any:
        """Run the command; raise its errors as they are to be printed."""
        try:
            try:
                return super().invoke(ctx)
            except RunnerError as error:
                raise Failure(error) from error
        except click.exceptions.NoArgsIsHelpError:
            raise
        except click.ClickException as error:
            raise (JsonFailure(error) if ctx.meta[_AS_JSON] else error) from error


def _forget_stdout() -> None:
    """Point stdout at nothing: its reader has left, and Python would complain about it at exit."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@click.group(
    cls=LazyGroup,
    epilog=_EPILOG,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(__version__, prog_name="dualtaxi", message="%(prog)s %(version)s")
def cli() -> None:
    """Record, replay and compare reinforcement-learning runs, every step of them."""


def main() -> None:
    """Run the command line; the console script."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")
    cli(prog_name="dualtaxi")
