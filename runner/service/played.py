"""What pages show of a run that takes long to find, computed by a child process."""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import sys
import threading
from collections.abc import Sequence
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from runner.recording.reader import Recording, open_recording
from runner.runs.run import Run
from runner.service.settings import without_folders

if TYPE_CHECKING:
    from runner.analysis.sections import Section
    from runner.sweep.results import Results

BEHIND: Final = 1
"""Steps before the first that is asked for, so that the one that led there can be told."""


def part(path: Path, which: tuple[int, ...], start: int, steps: int) -> bytes:
    """Return a part of an episode as JSON: what `replay.js` shows.

    Args:
        path: the recording.
        which: (episode,) of training, or (training episodes before, trial) of an evaluation.
        start: the first step.
        steps: at most so many.

    Raises:
        RecordingError: there is no such episode or step, or no steps were recorded.
    """
    from runner.drawing import svg
    from runner.export.reports.episode import payload, training_episode, trial

    with open_recording(path) as recording:
        recording.require_job("a replay in the page", "The Rerun viewer shows what it recorded.")
        first = max(0, start - BEHIND)
        found = (
            training_episode(recording, which[0], steps, first)
            if len(which) == 1
            else trial(recording, which[0], which[1], steps, first)
        )
        mdp = recording.mdp
        drawing = None if mdp.scene is None or mdp.scene_cells is None else svg.Drawing(mdp.scene)
        places = None if drawing is None else lambda states: drawing.places(mdp, states)
        told = payload(recording, [found], places)
        episode = told.pop("episodes")[0]
        episode |= {
            "description": found.outcome,
            "length": found.length,
            "first": found.first,
            "before": list(found.before),
        }
        told |= {"trail": svg.TRAIL, "episode": episode, "scene": mdp.scene}
        return json.dumps(told, separators=(",", ":"), ensure_ascii=False).encode()


def random_policy(path: Path) -> bytes:
    """Return what a random policy achieves in a recording's environment, as a sentence or nothing."""
    from runner.analysis.summary import random_policy_sentence

    with open_recording(path) as recording:
        return random_policy_sentence(recording).encode()


def typical(path: Path) -> bytes:
    """Return the address of the episode that is most worth looking at: `eval/3000/17`, or `train/0`."""
    from runner.export.reports.episode import last_episode, last_whole_evaluation, typical_trial

    with open_recording(path) as recording:
        if last_whole_evaluation(recording) is None:
            return f"train/{last_episode(recording)}".encode()
        after, number = typical_trial(recording)
        return f"eval/{after}/{number}".encode()


def learned(path: Path) -> bytes:
    """Return policy and values of a run at stages of learning, as JSON: a row of maps for each."""
    from runner.export.reports.maps import maps_of, stages_of

    with open_recording(path) as recording:
        if not recording.is_job:
            return b"[]"
        mdp = recording.mdp
        start = _typical_start(recording)
        rows = maps_of(mdp, recording.agents, stages_of(recording), start)
        return json.dumps([asdict(row) for row in rows]).encode()


def difference(a: Run, b: Run) -> bytes:
    """Return in what two runs differ, as JSON: what the page of `dualtaxi diff` tells and shows."""
    from runner.analysis.diff import diff, with_seconds, without_ignored
    from runner.export.reports.diff import told_of

    with open_recording(a.recording) as ours, open_recording(b.recording) as theirs:
        told = told_of(without_ignored(with_seconds(diff(ours, theirs), a, b), ()), ours, theirs)
    return json.dumps(told, default=asdict).encode()


def _typical_start(recording: Recording) -> int:
    from runner.errors import RecordingError
    from runner.export.reports.episode import trial, typical_trial

    try:
        return int(trial(recording, *typical_trial(recording)).states[0])
    except RecordingError:
        return int(recording.mdp.start.argmax())


def spot(run: Run, at: tuple[int, ...]) -> bytes:
    """Return the step of the viewer's timeline at (episode, t) or (training episodes before, trial, t)."""
    from runner.export.rerun.selection import Request, locate

    return str(locate(run, Request(), at or None).time).encode()


def load_sweep_libraries() -> None:
    """Import what the pages of sweeps need, in a thread that gives way to all others where that is possible.

    SciPy, scikit-learn and Optuna take seconds to load, which nobody should have to wait for.
    """

    def load() -> None:
        if sys.platform == "linux":  # elsewhere a priority is that of a whole process
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 10)
        for module in ("scipy.stats", "sklearn.tree", "optuna.samplers", "runner.sweep.results"):
            with contextlib.suppress(ImportError):  # whoever needs it says what to install
                importlib.import_module(module)

    thread = threading.Thread(target=load)
    thread.start()
    thread.join()


@lru_cache(maxsize=1)
def _results(name: str, recordings: Path, digest: str) -> Results:  # noqa: ARG001
    """Return what came of a sweep; the digest tells its states apart."""
    from runner.sweep.results import results_of
    from runner.sweep.state import read_sweep

    return results_of(read_sweep(name, recordings), recordings)


def sweep_results(name: str, recordings: Path, digest: str) -> bytes:
    """Return the ranking of a sweep, as JSON: sections as `dualtaxi sweep show` prints them, and the runs."""
    from runner.sweep.results import ranking_sections

    results = _results(name, recordings, digest)
    told = {
        "sections": _told_sections(ranking_sections(results, None), recordings),
        "runs": {entry.number: entry.runs for entry in results.ranking},
        "best": results.best_yaml,
    }
    return json.dumps(told, default=str).encode()


def sweep_importance(name: str, recordings: Path, digest: str) -> bytes:
    """Return what mattered in a sweep, as JSON: the section that `dualtaxi sweep show` prints, if any."""
    from runner.sweep.results import effects_sections

    sections = effects_sections(_results(name, recordings, digest))
    return json.dumps({"sections": _told_sections(sections, recordings)}, default=str).encode()


def _told_sections(sections: Sequence[Section], recordings: Path) -> list[dict[str, Any]]:
    return [
        asdict(section) | {"sentences": [without_folders(text, recordings) for text in section.sentences]}
        for section in sections
    ]


def sweep_pictures(name: str, recordings: Path, digest: str) -> bytes:
    """Return the pictures of a sweep, as JSON: its parameters, and how some of its trials learned."""
    from runner.errors import RunnerError
    from runner.sweep.charts import parallel_chart, parameter_chart
    from runner.sweep.plots import picture_of

    results = _results(name, recordings, digest)
    pictures, note = [], ""
    try:
        picture = picture_of(results)
        charts = [*(parameter_chart(picture, axis) for axis in picture.axes), parallel_chart(picture)]
        pictures, note = [chart.svg() for chart in charts], picture.footnote
    except RunnerError:  # no trial is finished yet, as the results say
        pass
    told = {
        "pictures": pictures,
        "note": note,
        "learning": _learning(results, recordings),
        "parameters": list(results.sweep.file.parameters),
    }
    return json.dumps(told, default=str).encode()


def _learning(results: Results, recordings: Path) -> dict[str, Any]:
    """Return how the best and the median trial of a sweep learned, or why that cannot be shown."""
    from runner.drawing import palette
    from runner.errors import RunnerError
    from runner.export.plots.curves import footnote, panel_plots
    from runner.sweep.plots import learning

    try:
        groups, panels = learning(results, recordings)
    except RunnerError as error:
        return {"note": without_folders(str(error), recordings), "legend": [], "panels": []}
    legend = [(number % len(palette.SERIES), group.described) for number, group in enumerate(groups)]
    plots = [plot._asdict() for plot in panel_plots(panels, len(groups))]
    return {"note": footnote(groups), "legend": legend, "panels": plots}
