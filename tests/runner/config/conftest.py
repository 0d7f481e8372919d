"""Fixtures of the tests of configurations."""

import pytest

from runner.config import load
from runner.errors import ConfigError


@pytest.fixture
def errors_of(tmp_path):
    """Return a function: the lines of the error for a file `x.yaml` with a text, without its folder."""

    def lines(text, overrides=()):
        path = tmp_path / "x.yaml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        with pytest.raises(ConfigError) as caught:
            load(path, overrides)
        return str(caught.value).replace(f"{tmp_path}/", "").splitlines()

    return lines
