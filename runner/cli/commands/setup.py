"""`dualtaxi init`, `config` and `completion`: folders, configurations and the shell."""

from __future__ import annotations

import json
from pathlib import Path

import click
from click.shell_completion import get_completion_class

from runner.analysis.sections import Grid
from runner.cli.command import Command, CommandGroup, argument
from runner.cli.options import config_argument, output_option, set_option
from runner.cli.output import Remark, Reply, echo, files_written
from runner.cli.parameter_types import DIRECTORY, SHIPPED


@click.command("init", cls=Command)
def init_command(folder: Path = argument(metavar="[FOLDER]", default=".", type=DIRECTORY)) -> Reply:
    """Create a folder to start in, with configs/, recordings/ and a README of what to type.

    FOLDER defaults to the current one. Existing files are left as they are.

    Examples:
      dualtaxi init
      dualtaxi init experiments
    """
    from runner.config.shipped import start_folder

    made: list[str] = []
    existing: list[str] = []
    for path, is_new in start_folder(folder):
        (made if is_new else existing).append(str(path))
    text = [*made]
    if existing:
        kept = f"{len(existing)} of {len(made) + len(existing)} existed already and were left as they are."
        text.append(Remark(kept))
    change = "" if folder == Path() else f"cd {folder} && "
    text.append(Remark(f"Next: {change}dualtaxi run configs/quick.yaml"))
    return Reply({"folder": str(folder.absolute()), "made": made, "kept": existing}, text)


@click.group("config", cls=CommandGroup)
def config_command() -> None:
    """List, copy and check configurations; print their schema.

    Examples:
      dualtaxi config ls
      dualtaxi config copy quick -o mine.yaml
      dualtaxi config check mine.yaml
      dualtaxi config schema > schema.json
    """


@config_command.command("ls")
def ls() -> Reply:
    """List the shipped experiments, for `run`, and sweeps, for `sweep run`.

    Example:
      dualtaxi config ls
    """
    from runner.config.shipped import shipped

    rows = [
        (configuration.name, configuration.kind, configuration.about) for configuration in shipped().values()
    ]
    configs = [
        {
            "name": configuration.name,
            "kind": configuration.kind,
            "about": configuration.about,
            "path": str(configuration.path),
        }
        for configuration in shipped().values()
    ]
    return Reply({"configs": configs}, [Grid(("name", "kind", "about"), rows)])


@config_command.command("copy")
def copy(
    name: str = argument(metavar="NAME", type=SHIPPED),
    output: Path | None = output_option("NAME.yaml"),
) -> Reply:
    """Copy the shipped experiment NAME into a file of your own, to change it.

    Examples:
      dualtaxi config copy quick
      dualtaxi config copy hyperparameters -o search.yaml
    """
    from runner.config.shipped import copy_shipped, find_shipped

    experiment = find_shipped(name)
    target = output or Path(f"{name}.yaml")
    copy_shipped(experiment, target)
    following = Remark(f"Next: {experiment.command.rpartition(' ')[0]} {target}")
    return Reply({"files": files_written(target), "name": name}, [str(target), following])


@config_command.command("check")
def check(config: Path = config_argument, overrides: tuple[str, ...] = set_option) -> Reply:
    """Check CONFIG, a file or a shipped experiment, and print it with every value spelled out.

    The output is a configuration again. All problems are reported at once, with file, line, column and key;
    the exit code is then 2. Whether the environment exists is checked by `dualtaxi run`, before it begins.

    Examples:
      dualtaxi config check quick
      dualtaxi config check mine.yaml --set episodes=50 --json
    """
    from runner.config import load

    experiment = load(config, overrides)
    text = f"# {config} is fine. Spelled out:\n{experiment.to_yaml().removesuffix(chr(10))}"
    return Reply({"file": str(config), "config": experiment.to_mapping()}, [text])


@config_command.command("schema")
def schema() -> Reply:
    """Print the JSON Schema of configuration files, with which editors check and complete them.

    It is JSON with or without --json.

    Example:
      dualtaxi config schema > configs/schema.json
    """
    from runner.config import json_schema

    text = json.dumps(json_schema(), indent=2)
    return Reply(text=[text], lines={"json": [text, "\n"]})


@click.command("completion", cls=Command, forms=())
def completion_command(shell: str = argument(type=click.Choice(["bash", "zsh", "fish"]))) -> None:
    """Print the script that makes SHELL complete commands, options, files and the names of runs.

    Examples:
      eval "$(dualtaxi completion bash)"                       now, in this shell
      dualtaxi completion bash >> ~/.bashrc                    from now on
      dualtaxi completion fish > ~/.config/fish/completions/dualtaxi.fish
    """
    from runner.cli import cli

    kind = get_completion_class(shell)
    if kind is None:
        raise click.BadParameter(f"click knows no completion for {shell}.")
    echo(kind(cli, {}, "dualtaxi", "_DUALTAXI_COMPLETE").source())
