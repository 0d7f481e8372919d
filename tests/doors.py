"""Lists every command and route, for tests that hold for all of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import click

from runner.cli import cli

Path = tuple[str, ...]
"""The words of a command."""


def walk(group: Any = cli, path: Path = ()) -> Iterator[tuple[Path, click.Command]]:
    """Yield the words of every command and group below a group, and the command."""
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        yield (*path, name), command
        if isinstance(command, click.Group):
            yield from walk(command, (*path, name))


def commands() -> dict[Path, click.Command]:
    """Return every command by its words, without groups."""
    return {path: command for path, command in walk() if not isinstance(command, click.Group)}


def routes(owner: Iterable[Any]) -> Iterator[tuple[str, str]]:
    """Yield the method and path of every route; of included routers without the prefix given there."""
    for route in owner:
        if hasattr(route, "path"):
            yield from ((method, route.path) for method in sorted(getattr(route, "methods", None) or ["GET"]))
        else:
            yield from routes(getattr(route, "original_router", route).routes)
