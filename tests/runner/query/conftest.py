"""What tests of queries share."""

from __future__ import annotations

import pytest

from runner.util.files import CACHE_VARIABLE


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(CACHE_VARIABLE, str(tmp_path_factory.mktemp("cache")))
        yield
