"""The command of a view: its inputs are arguments and options, its answer text, JSON, Markdown or a file."""

from __future__ import annotations

import io
import sys
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any, Final

import click

from runner.cli.command import Command, Declared, argument, option
from runner.cli.options import force_option, html_option
from runner.cli.output import Part, Reply, files_written, path_and_size, require_page
from runner.cli.parameter_types import FILE, INDEX, PATH, ExpressionText, Parsed
from runner.cli.progress import stage_line, steps_line
from runner.cli.runs import all_recorded_runs, compilation_notice, recorded_run, two_recorded_runs
from runner.export.places import new_file, require_new
from runner.runs.run import Run, command_for
from runner.util.humanize import size
from runner.views.view import Answer, Input, View

_STDOUT: Final = Path("-")
_SUBJECTS: Final = {"pair": two_recorded_runs, "runs": all_recorded_runs}
"""What several runs are named by."""


def command_of(view: View) -> Command:
    """Return the command of a view."""

    def call(
        subject: Any,
        output: Path | None = None,
        force: bool = False,
        **values: object,
    ) -> Reply:
        if output not in (None, _STDOUT):
            (require_page if view.is_of_runs else require_new)(output, force)
        from runner.analysis.contents import damage_of
        from runner.recording.reader import Recording, open_recording

        line = steps_line if view.counts_steps else stage_line
        is_recording = view.subject == "recording"
        opened = open_recording(subject.recording) if is_recording else nullcontext(subject)
        notes: list[str] = []
        with compilation_notice(), line(view.stage) as report, opened as content:
            reported = {"report": report} if view.counts_steps or view.is_of_runs else {}
            answer = view.compute(content, **values, **reported)
            if isinstance(content, Recording) and (damage := damage_of(subject, content)):
                notes.append(damage)
            if output not in (None, _STDOUT):
                with new_file(output, force) as temporary, temporary.open("wb") as stream:
                    answer.write(stream)
        exit_code = answer.exit_code if view.is_of_runs else 0
        if output == _STDOUT:
            file = io.BytesIO()  # NumPy writes to a pipe by itself, and not all of it if the reader ends
            answer.write(file)
            if sys.stdout.isatty():
                return Reply((), [file.getvalue().decode(errors="replace")], exit_code=exit_code)
            sys.stdout.buffer.write(file.getvalue())
            return Reply((), exit_code=exit_code)
        data, page = answer.as_json(), ""
        if output is not None:
            data |= {"files": files_written(output)}
            if view.is_of_runs:
                page = f"{output}: {answer.contents or size(output.stat().st_size)}"
                notes = [f"Note: {note}." for note in answer.notes]
            else:
                notes.append(path_and_size(output))
        return Reply(data, _text(subject, answer), page=page, notes=notes, exit_code=exit_code)

    declared = {
        "subject": _SUBJECTS.get(view.subject, recorded_run),
        **{name: _declared(each, view) for name, each in view.inputs.items()},
    }
    if view.file_ending:
        help_text = f"{view.file_help} FILE `-` is stdout."
        output = option("-o", "--output", type=FILE, metavar=f"FILE{view.file_ending}", help=help_text)
        declared |= {"output": output, "force": force_option}
    if view.is_of_runs:
        declared |= {"output": html_option, "force": force_option}
    return Command(view.name, call, declared, help=view.help)


def _text(run: Run, answer: Answer) -> Iterator[Part]:
    yield from answer.sections()
    if answer.step_to_look_at is not None:
        yield {"next": command_for(run, "view", "--at", str(answer.step_to_look_at))}


def _declared(given: Input, view: View) -> Declared:
    """Return the argument or option of an input; an argument completes the words that the view lists."""
    if given.required:
        return argument(metavar=given.name.upper(), type=ExpressionText(given.name, view.words))
    return option_of(given)


def option_of(given: Input) -> Declared:
    """Return the option of an input."""
    flag = f"--{given.name}"
    if given.kind is bool:
        return option(flag, is_flag=True, help=given.help)
    kind: Any = INDEX if given.kind is int else PATH if given.is_file else None
    if given.values:
        kind = click.Choice(given.values)
    if (check := given.check) is not None:
        kind = Parsed(given.name, given.metavar, lambda text: (check(text), text)[1])
    return option(
        flag,
        type=kind,
        default=given.default,
        multiple=given.multiple,
        metavar=given.metavar or None,
        help=given.help,
    )
