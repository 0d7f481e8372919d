"""Recordings for the tests of pictures and films."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from runner.recording.maker import MAKER_RECORD
from runner.recording.rewriting import rewrite


def made_otherwise(recording: Path, path: Path, **spec: Any) -> Path:
    """Write a copy of a recording that states other settings of its environment; return its path."""

    def changed(name: str, entries: dict[str, str]) -> dict[str, str]:
        if name != MAKER_RECORD:
            return entries
        maker = json.loads(entries["json"])
        maker["spec"] = json.dumps(json.loads(maker["spec"]) | spec)
        return {"json": json.dumps(maker)}

    rewrite(recording, path, changed)
    return path
