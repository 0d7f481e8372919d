"""A small finished sweep, and its file."""

from __future__ import annotations

import pytest
from sweeping import described, swept

from runner.config.document import write_yaml
from runner.sweep.model import from_values


@pytest.fixture(scope="session")
def sweep():
    return from_values(described())


@pytest.fixture(scope="session")
def done(sweep, tmp_path_factory):
    """The small sweep, finished: folder, trials, status."""
    folder = tmp_path_factory.mktemp("swept")
    return folder, *swept(folder, sweep)


@pytest.fixture
def file(tmp_path):
    """Return a function that writes a sweep file."""

    def write(**changes):
        path = tmp_path / "small.yaml"
        path.write_text(write_yaml(described(**changes)))
        return path

    return write
