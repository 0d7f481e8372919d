"""The command of a view: its inputs are arguments and options, its answer text, JSON, Markdown or a file."""

from __future__ import annotations

import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from runner.analysis.sections import Answer
from runner.cli.command import Command, Declared, argument, option
from runner.cli.options import (
    checkpoint_option,
    environment_options,
    episode_option,
    filter_argument,
    folders_option,
    force_option,
    html_option,
    policy_option,
    require_one,
    runs_option,
    tags_option,
    trial_option,
    trust_option,
)
from runner.cli.output import Part, Remark, Reply, files_written, path_and_size, require_page, say
from runner.cli.parameter_types import FILE, PATH, Number, Parsed, expression_text
from runner.cli.progress import bytes_line, count_line, progress_line, stage_line, steps_line
from runner.cli.runs import (
    all_recorded_runs,
    any_run,
    compilation_notice,
    named_sweep,
    recorded_run,
    recording_and_run,
    runs_folder,
    two_recorded_runs,
)
from runner.errors import RunnerError
from runner.runs.run import Run, command_for
from runner.util.files import new_file, require_new
from runner.util.humanize import size
from runner.views.view import ONLY_HERE, PAGE, Input, ShownProgress, View

if TYPE_CHECKING:
    from runner.recording.reader import Recording

_STDOUT: Final = Path("-")
_PROGRESS: Final = ShownProgress(say, stage_line, steps_line, bytes_line, count_line, progress_line)


@contextmanager
def _recording(run: Run) -> Iterator[Recording]:
    """Open the recording of a run, and name its damage in the end."""
    from runner.analysis.contents import damage_of
    from runner.recording.reader import open_recording

    with open_recording(run.recording) as recording:
        yield recording
        if damage := damage_of(run, recording):
            say(damage)


_SUBJECTS: Final[dict[str, tuple[Declared, Callable[..., AbstractContextManager[Any]]]]] = {
    "recording": (recorded_run, _recording),
    "run": (recorded_run, nullcontext),
    "any run": (any_run, nullcontext),
    "pair": (two_recorded_runs, nullcontext),
    "runs": (all_recorded_runs, nullcontext),
    "file": (recording_and_run, nullcontext),
    "folder": (runs_folder, nullcontext),
    "folders": (folders_option, nullcontext),
    "sweep": (named_sweep, nullcontext),
    "environment": (environment_options, nullcontext),
}
"""The subject of a view -> what its command names, and how that is opened."""
_ONLY_HERE: Final = {
    "words": filter_argument,
    "runs": runs_option,
    "tags": tags_option,
    "episode": episode_option,
    "trial": trial_option,
    "checkpoint": checkpoint_option,
    "policy": policy_option,
    "trust": trust_option,
}


def command_of(view: View) -> Command:
    """Return the command of a view."""
    named, opened = _SUBJECTS[view.subject]
    is_page = view.file_ending == PAGE

    def call(
        subject: Any, output: Path | None = None, force: bool = False, **values: object
    ) -> Iterator[Reply]:
        if output is not None:
            require_one("output", *(f"as_{form}" for form in view.forms if form in ("quiet", "csv")))
        if output not in (None, _STDOUT):
            require_free = require_page if is_page else require_new
            require_free(output, force)
        if view.shows_progress:
            values["progress"] = _PROGRESS
        with compilation_notice(), opened(subject) as content:
            with nullcontext() if view.shows_progress else stage_line("reading"):
                answer = view.compute(content, **values)
            if output is None:
                text = chain(_text(subject, answer), map(Remark, answer.hints))
                yield Reply(answer.as_json, text, answer.lines, "", answer.remarks, answer.exit_code)
                return
            if output == _STDOUT:
                with tempfile.TemporaryFile() as file:  # NumPy does not write all to a pipe whose reader ends
                    with stage_line("writing"):
                        answer.write(file)
                    file.seek(0)
                    if not sys.stdout.isatty():
                        shutil.copyfileobj(file, sys.stdout.buffer)
                    read = file.read().decode(errors="replace")
                    yield Reply(text=[read] * bool(read), notes=answer.remarks, exit_code=answer.exit_code)
                return
            with stage_line("writing"), new_file(output, force) as path, path.open("wb") as stream:
                answer.write(stream)
            data = answer.as_json() | {"files": files_written(output)}
            page = ""
            notes = [path_and_size(output)]
            if is_page or answer.contents:
                page = f"{output}: {answer.contents or size(output.stat().st_size)}"
                notes = [f"Note: {limit}." for limit in answer.limits]
            printed = () if answer.contents and not is_page else _text(subject, answer)
            yield Reply(data, printed, {}, page, chain(notes, answer.remarks), answer.exit_code)

    declared = {
        "subject": named,
        **{name: _declared(name, declared_input, view) for name, declared_input in view.inputs.items()},
    }
    if view.file_ending:
        help_text = f"{view.file_help} FILE `-` is stdout."
        metavar = f"FILE{view.file_ending}"
        output = option(*view.file_flags, type=FILE, metavar=metavar, help=help_text)
        declared |= {"output": html_option if is_page else output, "force": force_option}
    return Command(view.name.split()[-1], call, declared, forms=view.forms, help=view.help)


def _text(run: Run, answer: Answer) -> Iterator[Part]:
    yield from answer.sections()
    if answer.step_to_look_at is not None:
        yield {"next": command_for(run, "view", "--at", str(answer.step_to_look_at))}


def _declared(name: str, given: Input, view: View) -> Declared:
    """Return the argument or option of an input; an argument completes the words that the view lists."""
    if given is ONLY_HERE:
        if name not in _ONLY_HERE:
            expected = ", ".join(_ONLY_HERE)
            raise RunnerError(f"{view.name}: found {name!r} with ONLY_HERE, expected one of {expected}.")
        return _ONLY_HERE[name]
    if given.required:
        return argument(metavar=given.name.upper(), type=expression_text(given.name, view.words))
    return option_of(given)


def option_of(given: Input) -> Declared:
    """Return the option of an input."""
    flag = f"--{given.name}"
    if given.kind is bool:
        flags = flag if given.default is False else f"{flag}/--no-{given.name}"
        return option(flags, is_flag=True, default=given.default, help=given.help)
    kind: Any = PATH if given.is_file else None
    if given.kind in (int, float):
        kind = Number(given.minimum, given.maximum if given.kind is float else None, given.kind)
    if given.values:
        kind = click.Choice(tuple(given.values))
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
