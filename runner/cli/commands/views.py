"""The commands of views, see `runner.views`."""

from __future__ import annotations

from runner.cli.views import command_of
from runner.views import VIEWS

qtable_command = command_of(VIEWS["qtable"])
when_command = command_of(VIEWS["when"])
why_command = command_of(VIEWS["why"])
