"""Small models of Stable-Baselines3, and what is compared of them."""

from __future__ import annotations

import torch
from click.testing import CliRunner

import runner
from runner.cli import cli

SMALL = {"n_steps": 64, "batch_size": 32, "n_epochs": 2, "device": "cpu"}


def verified(run) -> str:
    """Return what `dualtaxi verify` prints of a run."""
    done = CliRunner().invoke(cli, ["verify", str(run.recording)])
    return f"{done.exit_code} {done.output}"


def logged(run) -> list[tuple[str, float]]:
    """Return the names and values of logged numbers, in their order."""
    with runner.open_recording(run.recording) as recording:
        return [(one["name"], one["value"]) for one in recording.table("/scalar").decoded()]


def weights(model) -> dict[str, torch.Tensor]:
    """Return a copy of the parameters of a policy."""
    return {name: value.clone() for name, value in model.policy.state_dict().items()}


def assert_equal_weights(one, other) -> None:
    """Assert that two policies have the same parameters, to the bit."""
    assert one.keys() == other.keys()
    assert all(torch.equal(one[name], other[name]) for name in one)
