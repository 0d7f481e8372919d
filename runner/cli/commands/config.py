"""`dualtaxi config`: list, copy and check configurations, print the schema."""

from __future__ import annotations

from pathlib import Path

import click

from runner.cli import Group
from runner.cli.options import SHIPPED, config_argument, json_option, set_option
from runner.cli.output import draw, print_json, say, table


@click.group("config", cls=Group)
def command() -> None:
    """List, copy and check configurations; print their schema.

    \b
    Examples:
      dualtaxi config ls
      dualtaxi config copy quick -o mine.yaml
      dualtaxi config check mine.yaml
      dualtaxi config schema > schema.json
    """  # noqa: D301 - Click wants the backspace itself


@command.command("ls")
@json_option
def ls(as_json: bool) -> None:
    """List the shipped experiments, which `run` takes by name, and sweeps, which `sweep` does.

    \b
    Example:
      dualtaxi config ls
    """  # noqa: D301 - Click wants the backspace itself
    from runner.config.shipped import shipped

    if as_json:
        configs = [
            {"name": each.name, "kind": each.kind, "about": each.about, "path": str(each.path)}
            for each in shipped().values()
        ]
        print_json({"configs": configs})
        return
    made = table("name", "kind", "about", left=("name", "kind", "about"), shrinking=("about",))
    for each in shipped().values():
        made.add_row(each.name, each.kind, each.about)
    draw(made)


@command.command("copy")
@click.argument("name", metavar="NAME", type=SHIPPED)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="The file to write.  [default: NAME.yaml]",
)
@json_option
def copy(name: str, output: Path | None, as_json: bool) -> None:
    """Copy the shipped experiment NAME into a file of your own, to change it.

    \b
    Examples:
      dualtaxi config copy quick
      dualtaxi config copy hyperparameters -o search.yaml
    """  # noqa: D301 - Click wants the backspace itself
    from runner.config.shipped import copy_shipped, find_shipped

    experiment = find_shipped(name)
    target = output or Path(f"{name}.yaml")
    copy_shipped(experiment, target)
    if as_json:
        print_json({"name": name, "path": str(target.absolute())})
    else:
        click.echo(target)
        say(f"Next: {experiment.command.rpartition(' ')[0]} {target}")


@command.command("check")
@config_argument
@set_option
@json_option
def check(config: Path, overrides: tuple[str, ...], as_json: bool) -> None:
    """Check CONFIG, a file or a shipped experiment, and print it with every value spelled out.

    The output is a configuration again. All problems are reported at once, with file, line, column and key;
    the exit code is then 2. Whether the environment exists is checked by `dualtaxi run`, before it begins.

    \b
    Examples:
      dualtaxi config check quick
      dualtaxi config check mine.yaml --set episodes=50 --json
    """  # noqa: D301 - Click wants the backspace itself
    from runner.config import load

    experiment = load(config, overrides)
    if as_json:
        print_json({"file": str(config), "config": experiment.to_mapping()})
    else:
        click.echo(f"# {config} is fine. Spelled out:")
        click.echo(experiment.to_yaml(), nl=False)


@command.command("schema")
@json_option
def schema(as_json: bool) -> None:  # noqa: ARG001 - a schema is JSON anyway
    """Print the JSON Schema of configuration files, with which editors check and complete them.

    It is JSON with or without --json.

    \b
    Example:
      dualtaxi config schema > configs/schema.json
    """  # noqa: D301 - Click wants the backspace itself
    from runner.config import json_schema

    print_json(json_schema(), indent=2)
