"""The commands of views, see `runner.views`."""

from __future__ import annotations

from runner.cli.views import command_of
from runner.views import VIEWS

console_command = command_of(VIEWS["console"])
qtable_command = command_of(VIEWS["qtable"])
system_command = command_of(VIEWS["system"])
when_command = command_of(VIEWS["when"])
why_command = command_of(VIEWS["why"])
