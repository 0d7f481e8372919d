"""Tests with real libraries, which warn of many things of their own; warnings of this project stay errors."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

os.environ.setdefault("OMP_NUM_THREADS", "1")  # PyTorch reads it: its threads wait for one another otherwise


def pytest_configure(config: pytest.Config) -> None:
    for line in ("ignore", "error::RuntimeWarning"):  # the last is what this project warns of
        config.addinivalue_line("filterwarnings", line)


@pytest.fixture
def recordings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder with an empty recordings folder in it, the current folder of the test."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DUALTAXI_RECORDINGS", str(tmp_path / "recordings"))
    return tmp_path / "recordings"
