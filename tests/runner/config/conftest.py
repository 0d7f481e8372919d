"""What the tests of configuration share."""

import pytest

from runner.config import load
from runner.errors import ConfigError


@pytest.fixture
def told(tmp_path):
    """Return the lines of the error for a file `x.yaml` of a text, without its folder."""

    def lines(text, overrides=()):
        path = tmp_path / "x.yaml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        with pytest.raises(ConfigError) as caught:
            load(path, overrides)
        return str(caught.value).replace(f"{tmp_path}/", "").splitlines()

    return lines
