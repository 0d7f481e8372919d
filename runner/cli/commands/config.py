"""`dualtaxi config`: check a configuration, print the schema."""

from __future__ import annotations

from pathlib import Path

import click

from runner.cli.options import config_argument, json_option, set_option
from runner.cli.output import print_json


@click.group("config")
def command() -> None:
    """Check a configuration; print the schema of one.

    \b
    Examples:
      dualtaxi config check configs/quick.yaml
      dualtaxi config schema > schema.json
    """  # noqa: D301 - Click wants the backspace itself


@command.command("check")
@config_argument
@set_option
@json_option
def check(config: Path, overrides: tuple[str, ...], as_json: bool) -> None:
    """Check the file CONFIG and print what it means, with every value spelled out.

    What is printed is a configuration again. Problems are told with file, line, column and key, all at
    once; the exit code is then 2. Whether there is such an environment is not looked up: `dualtaxi run`
    does so before it begins.

    \b
    Examples:
      dualtaxi config check configs/quick.yaml
      dualtaxi config check configs/quick.yaml --set episodes=50 --json
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
