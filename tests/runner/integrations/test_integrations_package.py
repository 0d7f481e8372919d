"""The package of adapters, where no library is needed."""

from __future__ import annotations

import subprocess
import sys

import pytest

import runner
from runner.errors import MissingExtra
from runner.integrations.libraries import require_tested


def test_no_library_is_imported_before_it_is_needed():
    program = "import sys, runner; dir(runner.integrations); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    libraries = {"stable_baselines3", "torch", "torchrl", "ray", "jax", "tensorboard", "wandb", "numpy"}
    assert not libraries & set(done.stdout.split())


def test_an_adapter_that_does_not_exist_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'keras'"):
        runner.integrations.keras  # noqa: B018


def test_a_library_that_is_not_installed_names_its_extra():
    with pytest.raises(MissingExtra, match=r"runner\.integrations\.sb3 needs absent_library.*\[sb3\]"):
        require_tested("absent_library", "sb3", ("1.0", "2.0"))


@pytest.mark.parametrize("version", ["1.9.9", "2.0.0", "2.1.7", "2.1rc1"])
def test_versions_in_the_tested_range_give_no_warning(version, monkeypatch):
    monkeypatch.setattr("numpy.__version__", version)
    require_tested("numpy", "sb3", ("1.9", "2.1"))  # a warning would be an error


@pytest.mark.parametrize("version", ["1.8.9", "2.2.0", "3.0"])
def test_other_versions_give_a_warning_with_the_range(version, monkeypatch):
    monkeypatch.setattr("numpy.__version__", version)
    with pytest.warns(RuntimeWarning, match=rf"numpy {version}, tested are 1\.9 to 2\.1"):
        require_tested("numpy", "sb3", ("1.9", "2.1"))
