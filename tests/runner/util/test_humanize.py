"""Values as people read them."""

from __future__ import annotations

import pytest

from runner.util.humanize import setting, size


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (True, "true"),
        (None, "not set"),
        (0.25, "0.25"),
        (1.0, "1"),
        (0.1234567891, "0.1234567891"),
        (12345678.0, "12345678.0"),
        ("drop-off", "drop-off"),
        ([1, "Zürich"], '[1, "Zürich"]'),
        ({"schedule": "linear", "start": 1.0, "end": 0.1, "over": 5000}, "linear 1 to 0.1 over 5,000"),
    ],
)
def test_a_setting_is_exact_and_as_in_a_configuration(value, text):
    assert setting(value) == text


@pytest.mark.parametrize(
    ("count", "text"), [(999, "999 B"), (1 << 20, "1.0 MB"), (256 << 20, "268 MB"), (4 * 10**9, "4.0 GB")]
)
def test_sizes_are_in_powers_of_a_thousand(count, text):
    assert size(count) == text
