"""The command line: parse, call one function, print, exit.

A command's module is imported when it is invoked, and imports heavy packages inside its functions, so that
help and completion are quick. `COMMANDS` says where each command is and what it is for.
"""

from __future__ import annotations

import contextlib
import errno
import importlib
import json
import os
import sys
from typing import IO, Final

import click

from runner.cli.command import CommandGroup
from runner.errors import (
    ConfigError,
    ExitCode,
    OutOfResources,
    RunnerError,
    StorageError,
    full_message,
)
from runner.util import __version__
from runner.util.extras import VIEWS
from runner.util.humanize import printable

_VIEW: Final = ""
"""Stands for the module of a command that follows from a view, see `runner.views`."""
COMMANDS: Final[dict[str, dict[str, tuple[str, str]]]] = {
    "Run": {
        "run": ("run", "Train, evaluate and record an experiment."),
        "sweep": ("sweep", "Run an experiment with many values, and rank them."),
        "resume": ("resume", "Resume an interrupted run, to the same content as an undisturbed one."),
        "evaluate": ("resume", "Evaluate a run's Q-table at any step in new episodes."),
        "rerecord": ("resume", "Record the steps of a run that was recorded without them."),
    },
    "Inspect": {
        "ls": (_VIEW, "List the recorded runs."),
        "find": (_VIEW, "Find the episodes of all runs that match an expression."),
        "sql": (_VIEW, "Ask the recorded runs, and every step of them, in SQL."),
        "show": (_VIEW, "Show a run: evaluations, tables, configuration."),
        "episodes": (_VIEW, "Show the episodes of a run: how each ended, its length and returns."),
        "evaluations": (_VIEW, "Show the evaluations of a run, every event counted."),
        "code": (_VIEW, "Show the code that ran: commit, changes and files."),
        "console": (_VIEW, "Show what the process that recorded a run printed."),
        "system": (_VIEW, "Show how fast a run went, and what it used of its machine."),
        "play": ("play", "Replay a recorded episode in the terminal."),
        "view": ("play", "Open runs in the Rerun viewer."),
        "plot": ("report", "Draw every metric of one or several runs over episodes."),
        "report": ("report", "Write one self-contained page about one or several runs."),
        "diff": (_VIEW, "Show what differs between two runs, and where they diverge."),
        "compare": (_VIEW, "Compare groups of runs, with statistics over seeds."),
        "verify": (_VIEW, "Check every step of a run: retrain it, or rerun its environment."),
        "checkpoints": (_VIEW, "List the checkpoints that a loop recorded."),
        "checkpoint": ("archive", "Write a checkpoint of a run into a file."),
        "values": (_VIEW, "Compute what a checkpoint's agent returns along a recorded episode."),
        "qtable": (_VIEW, "Show the exact Q-table of a run at any step."),
        "table": (_VIEW, "Print an environment's transition table with names."),
    },
    "Debug": {
        "branch": ("debug", "Change a recorded step, and see where that leads."),
        "when": (_VIEW, "Find the training steps after which something holds, such as a Q-value."),
        "why": (_VIEW, "Show the rewards and initial values that a Q-value is the sum of."),
        "explain": ("debug", "Find which settings make the difference between two runs."),
    },
    "Manage": {
        "label": ("catalogue", "Change the name, note and tags of a run."),
        "mark": ("catalogue", "Mark steps of a run, and list its marks."),
        "rm": ("catalogue", "Remove runs."),
        "prune": ("catalogue", "Remove old, unfinished or unwanted runs."),
        "du": (_VIEW, "Show what uses disk space, and what could be freed."),
        "repair": ("resume", "Repair a damaged recording, and report what was lost."),
        "index": ("catalogue", "Rebuild the index of runs."),
        "init": ("setup", "Create a folder to start in, with the shipped experiments."),
        "config": ("setup", "List, copy and check configurations; print their schema."),
        "completion": ("setup", "Print the completion script of a shell."),
    },
    "Archive": {
        "archive": ("archive", "Archive runs as Parquet files, losslessly."),
        "restore": ("archive", "Restore the recording of an archived run."),
    },
    "Share": {
        "export": ("export", "Export a run for other programs."),
        "import": ("archive", "Import a recording into the folder of runs."),
        "remote": ("server", "Upload and download runs; submit and control jobs."),
        "serve": ("server", "Serve the runs to browsers and programs over HTTP."),
        "token": ("server", "Create, list and revoke access tokens of a server."),
    },
}
"""Section -> command -> its module in `runner.cli.commands`, or `_VIEW`; and its short help."""

_DISK_FULL: Final = tuple(getattr(errno, name) for name in ("ENOSPC", "EDQUOT") if hasattr(errno, name))
_NO_THREAD: Final = "can't start new thread"
"""Python's message where the system gives no thread, which has no class of its own."""
_NOT_LOADED: Final = ("load shared object", "failed to map segment")
"""Parts of the messages about a library for which there is too little memory."""

_WRONG_PATH: Final = (
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
"""Errors in writing that mean a wrong path rather than a full or broken disk."""
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
    """A `RunnerError` or usage error, about a run or not, printed without a traceback.

    With --json it is a line of JSON, in the form of the service's API.
    """

    def __init__(self, error: RunnerError | click.ClickException, run: str = "") -> None:
        if isinstance(error, click.ClickException):
            super().__init__(error.format_message())
            self.exit_code = error.exit_code  # type: ignore[misc]  # Click's own classes do so
        else:
            super().__init__(full_message(error))
            self.exit_code = exit_code_of(error)  # type: ignore[misc]
        self.problems = error.problems if isinstance(error, ConfigError) else ()
        self.run = run
        self.as_json = click.get_current_context().meta[_AS_JSON]

    def show(self, file: IO[str] | None = None) -> None:
        """Print the message; each of several problems has a line, which begins with its place."""
        message = f"{self.run}: {self.message}" if self.run else self.message
        lines = message.count("\n") + 1
        head = f"{lines} problems\n" if self.problems and lines > 1 else ""
        text = f"Error: {head}{message}"
        if self.as_json:
            problems = [problem._asdict() for problem in self.problems]
            about = {"run": self.run} if self.run else {}
            error = {"message": message, "exit_code": self.exit_code, **about, "problems": problems}
            text = json.dumps({"error": error})
        click.echo(printable(text), file=file or sys.stderr)


def exit_code_of(error: RunnerError) -> int:
    """Return the exit code for an error: wrong usage if a path that the user named cannot be written."""
    cause = error.__cause__
    if isinstance(error, StorageError) and isinstance(cause, OSError) and cause.errno in _WRONG_PATH:
        return ExitCode.USAGE
    return error.exit_code


def _system_error(error: Exception) -> RunnerError | None:
    """Return our error for an error of the system: a full disk, too little memory, too many open files."""
    number = error.errno if isinstance(error, OSError) else None
    limit = ""
    if number in _DISK_FULL and isinstance(error, OSError):
        return StorageError(f"{error.filename or 'stdout'}: {error.strerror}.")
    if number in (errno.EMFILE, errno.ENFILE):
        limit = "more open files (`ulimit -n`)"
    elif number in (errno.ENOMEM, errno.EAGAIN) or isinstance(error, MemoryError) or _NO_THREAD in str(error):
        limit = "more memory (`ulimit -v`) and processes (`ulimit -u`)"
    elif number is None and any(text in str(error) for text in _NOT_LOADED):
        limit = "more memory (`ulimit -v`), or install the package again"
    if not limit:
        return None
    reason = (str(error) or type(error).__name__).partition(". ")[0]
    found = OutOfResources(f"the system refused: {reason}. Allow {limit}.")
    for note in getattr(error, "__notes__", []):
        found.add_note(note)
    return found


def view_command(name: str) -> click.Command:
    """Return the command of a view."""
    from runner.cli.views import command_of
    from runner.views import view_named

    return command_of(view_named(name))


class LazyGroup(CommandGroup):
    """The commands of `COMMANDS`, each imported when it is invoked."""

    def shipped(self) -> list[str]:
        """Return the names, section by section."""
        return [name for section in COMMANDS.values() for name in section]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import a command."""
        modules = {name: row[0] for section in COMMANDS.values() for name, row in section.items()}
        if cmd_name not in modules:
            return super().get_command(ctx, cmd_name)
        if modules[cmd_name] == _VIEW:
            return view_command(cmd_name)
        module = importlib.import_module(f"runner.cli.commands.{modules[cmd_name]}")
        command: click.Command = getattr(module, f"{cmd_name}_command")
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the sections from their short help, without an import."""
        width = max(len(name) for name in self.list_commands(ctx))
        sections: dict[str, list[tuple[str, str]]] = {
            title: [(name, text) for name, (_, text) in commands.items()]
            for title, commands in COMMANDS.items()
        }
        for title, rows in (sections | {"Installed": self.installed_rows()}).items():
            if rows:
                with formatter.section(title):
                    formatter.write_dl([(f"{name:{width}}", text) for name, text in rows])

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Note whether the command prints JSON before it is parsed: a usage error is JSON too."""
        ctx.meta[_AS_JSON] = "--json" in args
        return super().parse_args(ctx, args)

    def invoke(self, ctx: click.Context) -> object:
        """Run the command; errors that a user can correct have no traceback."""
        try:
            result = super().invoke(ctx)
            sys.stdout.flush()
            return result
        except (KeyboardInterrupt, click.Abort) as interrupt:
            for note in getattr(interrupt, "__notes__", []):  # such as how far a query has read
                click.echo(printable(note), err=True)
            raise click.exceptions.Exit(ExitCode.INTERRUPTED) from None
        except BrokenPipeError:
            with contextlib.suppress(OSError, ValueError):  # else Python complains about stdout at exit
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise click.exceptions.Exit(ExitCode.OK) from None
        except RunnerError as error:
            raise Failure(error) from error
        except (OSError, MemoryError, RuntimeError, ImportError) as error:
            if (understood := _system_error(error)) is None:
                raise
            raise Failure(understood) from error
        except click.exceptions.NoArgsIsHelpError:
            raise
        except click.ClickException as error:
            error.message = printable(error.message)  # type: ignore[misc]  # final by name alone
            raise (Failure(error) if ctx.meta[_AS_JSON] else error) from error


@click.group(
    cls=LazyGroup,
    plugins=VIEWS,
    plugin=view_command,
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
