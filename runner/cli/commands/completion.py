"""`dualtaxi completion`: the completion script of a shell."""

from __future__ import annotations

import click


@click.command("completion")
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def command(shell: str) -> None:
    """Print the script that makes SHELL complete commands, options, files and the names of runs.

    \b
    Examples:
      eval "$(dualtaxi completion bash)"                       now, in this shell
      dualtaxi completion bash >> ~/.bashrc                    from now on
      dualtaxi completion fish > ~/.config/fish/completions/dualtaxi.fish
    """  # noqa: D301 - Click wants the backspace itself
    from click.shell_completion import get_completion_class

    from runner.cli import cli

    kind = get_completion_class(shell)
    if kind is None:
        raise click.BadParameter(f"click knows no completion for {shell}.")
    click.echo(kind(cli, {}, "dualtaxi", "_DUALTAXI_COMPLETE").source())
