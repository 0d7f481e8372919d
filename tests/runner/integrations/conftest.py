"""Each test of an adapter runs in a folder of its own."""

from __future__ import annotations

import pytest

from runner.integrations import wandb


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Run each test in a folder of its own, with its recordings; no run stays open."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DUALTAXI_RECORDINGS", str(tmp_path / "recordings"))
    yield tmp_path
    if wandb.run is not None:
        wandb.finish()
