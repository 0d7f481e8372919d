"""The command of a view: its inputs are arguments and options, its answer text, JSON, Markdown or a file."""

from __future__ import annotations

import io
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Final

import click

from runner.cli.command import Command, Declared, argument, option
from runner.cli.options import (
    force_option,
)
from runner.cli.output import Reply, files_written
from runner.cli.parameter_types import FILE, INDEX, ExpressionText
from runner.cli.progress import stage_line, steps_line
from runner.cli.runs import compilation_notice, recorded_run
from runner.export.places import new_file, require_new
from runner.runs.run import Run, command_for
from runner.util.humanize import size
from runner.views.view import Input, View

_STDOUT: Final = Path("-")


def command_of(view: View) -> Command:
    """Return the command of a view."""

    def call(
        run: Run,
        output: Path | None = None,
        force: bool = False,
        **values: object,
    ) -> Reply:
        if output not in (None, _STDOUT):
            require_new(output, force)
        from runner.analysis.contents import damage_of
        from runner.recording.reader import Recording, open_recording

        line = steps_line if view.counts_steps else stage_line
        opened = nullcontext(run) if view.takes_run else open_recording(run.recording)
        notes: list[str] = []
        with compilation_notice(), line(view.stage) as report, opened as subject:
            answer = view.compute(subject, **values, **({"report": report} if view.counts_steps else {}))
            if isinstance(subject, Recording) and (damage := damage_of(run, subject)):
                notes.append(damage)
        if output == _STDOUT:
            file = io.BytesIO()  # NumPy writes to a pipe by itself, and not all of it if the reader ends
            answer.write(file)
            if sys.stdout.isatty():
                return Reply((), [file.getvalue().decode(errors="replace")])
            sys.stdout.buffer.write(file.getvalue())
            return Reply(())
        data, text = answer.as_json(), [*answer.sections()]
        if answer.step_to_look_at is not None:
            text.append({"next": command_for(run, "view", "--at", str(answer.step_to_look_at))})
        if output is not None:
            with new_file(output, force) as temporary, temporary.open("wb") as stream:
                answer.write(stream)
            data |= {"files": files_written(output)}
            notes.append(f"{output}  {size(output.stat().st_size)}")
        return Reply(data, text, notes=notes)

    declared = {
        "run": recorded_run,
        **{name: _declared(each, view) for name, each in view.inputs.items()},
    }
    if view.file_ending:
        help_text = f"{view.file_help} FILE `-` is stdout."
        output = option("-o", "--output", type=FILE, metavar=f"FILE{view.file_ending}", help=help_text)
        declared |= {"output": output, "force": force_option}
    return Command(view.name, call, declared, help=view.help)


def _declared(given: Input, view: View) -> Declared:
    """Return the argument or option of an input; an argument completes the words that the view lists."""
    if given.required:
        return argument(metavar=given.name.upper(), type=ExpressionText(given.name, view.words))
    flag = f"--{given.name}"
    if given.kind is bool:
        return option(flag, is_flag=True, help=given.help)
    kind = click.Choice(given.values) if given.values else INDEX if given.kind is int else None
    metavar = given.metavar or None
    return option(flag, type=kind, default=given.default, metavar=metavar, help=given.help)
