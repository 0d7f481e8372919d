"""Views of sweeps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

from runner.analysis.sections import Section
from runner.sweep import sweeps_in
from runner.views.view import EVERYTHING, NO_PROGRESS, ReadyAnswer, ShownProgress, View

if TYPE_CHECKING:
    from runner.sweep.results import Results


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


SWEEP_LS: Final = View("sweep ls", "Sweeps", sweep_ls, subject="folder")


def sweep_show(
    sweep: tuple[str, Path],
    everything: bool = EVERYTHING,
    progress: ShownProgress = NO_PROGRESS,
) -> Results:
    """Rank the trials of the sweep NAME with intervals over seeds, and show which parameters mattered.

    The value of a trial is the median over its seeds, shown with the interquartile mean (IQM) and its 95 %
    bootstrap interval, for four seeds and more. What mattered is the share of the objective's variance that
    each parameter explains (functional ANOVA), and each pair in a completed grid. --all lists every trial.

    Examples:
      dualtaxi sweep show hyperparameters
      dualtaxi sweep show hyperparameters --write-best best.yaml
    """
    from runner.sweep.results import results_of

    with progress.stage("ranking trials"):
        results = results_of(*sweep)
    return replace(results, shown=None) if everything else results


SWEEP_SHOW: Final = View(
    "sweep show",
    "Sweep",
    sweep_show,
    subject="sweep",
    file_ending=".yaml",
    file_flags=("--write-best",),
    file_help="Write the best configuration, with fresh seeds; `dualtaxi run` confirms it.",
)
