"""Shipped experiments are found by name in any folder."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

import runner
from runner.cli import cli
from runner.config import ConfigError, load
from runner.config.shipped import SCHEMA_FILE, config_path, shipped, shipped_folder
from runner.sweep.model import load_sweep


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """An empty working directory."""
    monkeypatch.chdir(tmp_path)


def type_in(*words, code=0):
    done = CliRunner().invoke(cli, words)
    assert done.exit_code == code, done.output
    return done


def test_a_shipped_experiment_is_loaded_by_its_name():
    assert load("quick").name == "quick"
    assert load_sweep("modes").name == "modes"
    run = runner.run("quick", overrides=["episodes=2", "evaluation=null"], recordings="recordings")
    assert run.name == "quick"


def test_a_file_has_priority_over_a_shipped_name(tmp_path):
    Path("quick").write_text("episodes: 7\n")
    assert load("quick").episodes == 7
    assert config_path("configs/quick") == Path("configs/quick")


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("quik", "Did you mean 'quick'?"),
        ("configs/quick.yaml", "`dualtaxi run quick`"),
        ("sweeps/modes.yaml", "`dualtaxi sweep run modes`"),
        ("nothing", "`dualtaxi config ls`"),
    ],
)
def test_an_unknown_name_is_refused_with_the_nearest(name, expected):
    with pytest.raises(ConfigError, match=r"no such file") as raised:
        load(name)
    assert expected in str(raised.value)


def test_every_shipped_experiment_is_listed_with_its_description():
    names = {file.stem for file in shipped_folder().glob("**/*.yaml")}
    assert set(shipped()) == names
    text = type_in("config", "ls").stdout
    for each in shipped().values():
        assert each.about
        assert each.name in text


def test_a_copy_loads_equal_and_replaces_no_file():
    type_in("config", "copy", "quick", "-o", "mine.yaml")
    assert load("mine.yaml").episodes == load("quick").episodes
    assert SCHEMA_FILE not in Path("mine.yaml").read_text()
    assert "exists already" in type_in("config", "copy", "quick", "-o", "mine.yaml", code=2).stderr
    assert "Did you mean 'quick'" in type_in("config", "copy", "quik", code=2).stderr


def test_a_start_folder_is_created_and_no_file_replaced(tmp_path):
    (tmp_path / "configs").mkdir()
    (tmp_path / "configs" / "quick.yaml").write_text("episodes: 7\n")
    type_in("init")
    assert (tmp_path / "configs" / "quick.yaml").read_text() == "episodes: 7\n"
    assert (tmp_path / "recordings").is_dir()
    assert "dualtaxi run" in (tmp_path / "README.md").read_text()
    assert (tmp_path / "configs" / "schema.json").is_file()
    assert "left as they are" in type_in("init").stderr


def test_a_sweep_loaded_as_experiment_names_the_right_command(tmp_path):
    Path("many.yaml").write_text("base: {episodes: 5}\nstrategy: grid\nparameters: {discount: [0.5]}\n")
    Path("one.yaml").write_text("episodes: 5\n")
    assert "`dualtaxi sweep run many.yaml`" in type_in("run", "many.yaml", code=2).stderr
    assert "`dualtaxi run`" in type_in("sweep", "run", "one.yaml", code=2).stderr


def test_errors_of_a_sweep_and_of_its_base_are_reported_together():
    Path("bad.yaml").write_text(
        "base: {episodes: -1, epsilon: 7}\nstrategy: gird\nparameters: {discount: []}\nsides: 3\n"
    )
    errors = type_in("sweep", "run", "bad.yaml", code=2).stderr
    for key in ("episodes", "epsilon", "strategy", "parameters", "sides"):
        assert f": {key}" in errors or f".{key}" in errors
