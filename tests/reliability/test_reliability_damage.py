"""Single changed bytes, a hundred of them; `python -m tests.reliability.damage` tries ten thousand."""

from __future__ import annotations

from tests.reliability.damage import changes_not_found


def test_verify_finds_any_changed_byte(tmp_path):
    assert changes_not_found(tmp_path, changes=120, seed=2) == []
