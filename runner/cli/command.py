"""Commands as functions, whose parameters' defaults declare the arguments and options.

The command `qtable`, for example:

    @click.command("qtable", cls=Command)
    def qtable_command(
        run_name: str = argument(metavar="RUN"),
        step: int | None = option("--step", type=INDEX, help="After N training steps."),
    ) -> None: ...
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final

import click

from runner.errors import nearest
from runner.util.extras import plugin_names

_MAX_SHORT_HELP: Final = 200
_FORMS: Final = {
    "quiet": ("-q", "--quiet", "Print ids only."),
    "csv": ("--csv", "Print CSV."),
    "json": ("--json", "Print JSON."),
    "markdown": ("--markdown", "Print Markdown."),
}
"""Forms of a reply: the flags and the help of the option of each."""

Declared = Any
"""The default of a parameter, which stands for values of the parameter's own type."""


def argument(**attributes: Any) -> Declared:
    """Return the default of a parameter that is an argument; attributes as for `click.Argument`."""
    return lambda name: click.Argument([name], **attributes)


def option(*flags: str, **attributes: Any) -> Declared:
    """Return the default of a parameter that is an option; attributes as for `click.Option`."""
    return lambda name: click.Option([name, *flags], **attributes)


def record(make: Callable[..., object]) -> Declared:
    """Return the default of a parameter that a function makes of several arguments and options.

    The defaults of the function's own parameters declare them.
    """
    return _Record(make)


class _Record:
    """What a function returns, given the values of the arguments and options that its parameters declare."""

    def __init__(self, make: Callable[..., object], declared: Mapping[str, Declared] | None = None) -> None:
        self._make = make
        parameters = inspect.signature(make).parameters.values()
        self._declared = declared or {parameter.name: parameter.default for parameter in parameters}

    def parameters(self) -> Iterator[click.Parameter]:
        """Yield the arguments and options."""
        for name, declared in self._declared.items():
            if isinstance(declared, _Record):
                yield from declared.parameters()
            else:
                yield declared(name)

    def __call__(self, **values: object) -> object:
        """Call the function with its part of all values."""
        fields = {
            name: declared(**values) if isinstance(declared, _Record) else values[name]
            for name, declared in self._declared.items()
        }
        return self._make(**fields)


def _with_examples(text: str | None) -> str | None:
    """Return a help text with Click's mark for preformatted text before its examples and other lists."""
    return text and re.sub(r"\n\n(?=[A-Z][a-z ]*:\n)", "\n\n\b\n", inspect.cleandoc(text))


class Command(click.Command):
    """A command of a function; its help keeps the lines of its examples.

    The defaults of the function's parameters declare them, unless they are `declared`; `params` are further
    ones, which the function does not get. The function returns a `Reply` or yields several; it is printed
    as text, or in the form that --json or another of the `forms` demands. What several records declare by one
    name is one option.
    """

    def __init__(
        self,
        name: str | None,
        callback: Callable[..., object],
        declared: Mapping[str, Declared] | None = None,
        params: Sequence[click.Parameter] = (),
        forms: Sequence[str] = ("json", "markdown"),
        **attributes: Any,
    ) -> None:
        call = _Record(callback, declared)
        declared_once = {parameter.name: parameter for parameter in call.parameters()}
        flags = [
            click.Option([f"as_{form}", *names], is_flag=True, help=text)
            for form, (*names, text) in _FORMS.items()
            if form in forms
        ]
        super().__init__(name, callback=call, params=[*declared_once.values(), *params, *flags], **attributes)
        self.help = _with_examples(self.help)
        self.forms = forms

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments; where settings can be changed, an unknown option is probably one of them."""
        try:
            return super().parse_args(ctx, args)
        except click.NoSuchOption as error:
            is_near = error.possibilities or not error.option_name.startswith("--")
            if is_near or not any("--set" in parameter.opts for parameter in self.params):
                raise
            name = error.option_name.lstrip("-").replace("-", "_")
            message = f"{error.message} A setting is changed by --set {name}=VALUE."
            raise click.NoSuchOption(error.option_name, message, error.possibilities, ctx) from None

    def invoke(self, ctx: click.Context) -> None:
        """Call the function, and print its replies in the form that the options name."""
        forms = [form for form in self.forms if ctx.params[f"as_{form}"]]
        if len(forms) > 1:
            raise click.UsageError(f"--{forms[0]} and --{forms[1]} exclude each other: choose one.")
        if replies := super().invoke(ctx):
            from runner.cli.output import print_replies

            ctx.exit(print_replies(replies, *forms))


class CommandGroup(click.Group):
    """A group of such commands, which suggests the nearest name for an unknown one.

    Args:
        plugins: the entry points by which installed packages add commands; empty for none.
        plugin: imports a command that is not defined here: of a view, or of another package.
        views: short help of the group's views, by the name of the command.
        prefix: prefix of the names of views in this group: `sweep ` for the view `sweep show`.
    """

    command_class = Command

    def __init__(
        self,
        name: str | None,
        *,
        plugins: str = "",
        plugin: Callable[[str], click.Command] | None = None,
        views: Mapping[str, str] = MappingProxyType({}),
        prefix: str = "",
        **attributes: Any,
    ) -> None:
        super().__init__(name, **attributes)
        self.plugins, self.plugin, self.views, self.prefix = plugins, plugin, views, prefix
        self.help = _with_examples(self.help)

    def shipped(self) -> list[str]:
        """Return the names of the commands of this package, in the order of definition."""
        return [*self.commands, *self.views]

    def installed(self) -> dict[str, str]:
        """Return the names of commands that other packages add, and the package of each."""
        names = plugin_names(self.plugins) if self.plugins else {}
        return {
            name: package
            for view, package in names.items()
            if view.startswith(self.prefix)
            and " " not in (name := view.removeprefix(self.prefix))
            and name not in self.shipped()
        }

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002
        """Return the names, those that other packages add last."""
        return [*self.shipped(), *self.installed()]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return a command."""
        command = super().get_command(ctx, cmd_name)
        if command is None and self.plugin is not None and cmd_name in self.list_commands(ctx):
            return self.plugin(f"{self.prefix}{cmd_name}")
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find a command, or suggest one."""
        is_known = args[0] in self.shipped() or args[0].startswith("-") or ctx.resilient_parsing
        if not is_known and args[0] not in (names := self.list_commands(ctx)):
            commands = {name: self.get_command(ctx, name) for name in self.shipped()}
            inside = [
                f" Did you mean '{name} {args[0]}'?"
                for name, command in commands.items()
                if isinstance(command, click.Group) and args[0] in command.list_commands(ctx)
            ]
            near = inside[0] if inside else nearest(args[0], names)
            ctx.fail(f"there is no command {args[0]!r}.{near}")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        """List the commands with the first sentence of their help, wrapped instead of cut off."""
        texts = {name: command.get_short_help_str(_MAX_SHORT_HELP) for name, command in self.commands.items()}
        with formatter.section("Commands"):
            formatter.write_dl([*texts.items(), *self.views.items(), *self.installed_rows()])

    def installed_rows(self) -> list[tuple[str, str]]:
        """Return the rows of the help about the commands that other packages add."""
        return [(name, f"From the package {package}.") for name, package in self.installed().items()]
