"""The command of a view: its inputs are arguments and options, its answer is text, JSON or Markdown."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from runner.cli.command import Command, Declared, argument, option
from runner.cli.options import json_option, markdown_option, recordings_option, require_one, run_argument
from runner.cli.output import draw, facts, print_json, print_sections
from runner.cli.parameter_types import INDEX
from runner.cli.progress import steps_line
from runner.cli.runs import command_for, compilation_notice, find_recorded
from runner.views.view import Input, View


def command_of(view: View) -> Command:
    """Return the command of a view."""

    def call(
        run_name: str, recordings: Path | None, as_json: bool, as_markdown: bool, **values: object
    ) -> None:
        require_one("as_json", "as_markdown")
        run = find_recorded(run_name, recordings)
        from runner.recording.reader import open_recording

        with compilation_notice(), steps_line("read") as report, open_recording(run.recording) as recording:
            answer = view.compute(recording, **values, report=report)
        if as_json:
            print_json(answer.as_json())
            return
        print_sections(answer.sections(), as_markdown)
        if answer.step_to_look_at is not None and not as_markdown:
            draw(facts({"next": command_for(run, "view", "--at", str(answer.step_to_look_at))}))

    shared: dict[str, Any] = {
        "recordings": recordings_option,
        "as_json": json_option,
        "as_markdown": markdown_option,
    }
    inputs = {name: _declared(each) for name, each in view.inputs.items()}
    return Command(view.name, call, {"run_name": run_argument} | inputs | shared, help=view.help)


def _declared(given: Input) -> Declared:
    """Return the argument or option of an input."""
    if given.required:
        return argument(metavar=given.name.upper())
    if isinstance(given.default, bool):
        return option(f"--{given.name}", is_flag=True, help=given.help)
    kind = INDEX if isinstance(given.default, int) else None
    flag = f"--{given.name}"
    return option(flag, type=kind, default=given.default, metavar=given.metavar, help=given.help)
