"""`sweep ls`: the sweeps of a folder."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from runner.analysis.sections import Section
from runner.sweep import sweeps_in
from runner.views.view import ReadyAnswer, View


def sweep_ls(recordings: Path) -> ReadyAnswer:
    """List the sweeps of a recordings folder.

    Example:
      dualtaxi sweep ls
    """
    names = sweeps_in(recordings)
    return ReadyAnswer(
        {"sweeps": names},
        [Section("", names)] if names else [],
        lines={"text": [f"{name}\n" for name in names]},
        remarks=[] if names else ["No sweeps yet. `dualtaxi sweep run FILE` starts one."],
    )


VIEW: Final = View("sweep ls", "Sweeps", sweep_ls, subject="folder")
