"""Where exports write: what killed ones left is removed by the next one."""

from __future__ import annotations

import os
import time

from runner.util.files import new_file


def test_the_next_export_removes_what_killed_ones_left_and_nothing_else(tmp_path):
    left_over = []
    for _ in range(2):
        with new_file(tmp_path / "a.gif", True) as path:
            left_over.append(path)
            path.write_bytes(b"a")
    own = tmp_path / ".mine.gif"
    for path in (*left_over, own):
        path.write_bytes(b"half")
    hours_ago = time.time() - 7_200
    os.utime(left_over[0], (hours_ago, hours_ago))
    os.utime(own, (hours_ago, hours_ago))
    with new_file(tmp_path / "b.gif", False) as path:
        path.write_bytes(b"b")
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"a.gif", "b.gif", ".mine.gif", left_over[1].name}  # which may still be written
