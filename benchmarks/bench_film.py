"""Frames of a film: composed of cached parts, against each rendered completely from its SVG."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import runner
from benchmarks.figures import Figure, figure
from runner.drawing import svg
from runner.export.gif import Film, render_svg
from runner.export.reports.episode import training_episode
from runner.recording.reader import open_recording


def measure(quick: bool) -> list[Figure]:
    """Return the processor time per frame of both methods, over the same frames of one episode."""
    count = 20 if quick else 100
    config = {"name": "film", "mode": "cooperative", "episodes": 5, "seed": 0}
    with tempfile.TemporaryDirectory() as folder:
        run = runner.run(config, recordings=Path(folder))
        with open_recording(run.recording) as recording:
            episode, mdp = training_episode(recording, 0, count), recording.mdp
            assert mdp.scene is not None
            film, drawing = Film(recording, episode), svg.Drawing(mdp.scene)
            places = drawing.places(mdp, episode.states)
            left, top, right, bottom = film.grid_box
            composed, whole = [], []
            for number in range(len(film)):
                began = time.process_time()
                film.frame(number)
                composed.append(1000 * (time.process_time() - began))
                began = time.process_time()
                render_svg(
                    drawing.frame(places[number], "", places[: number + 1]), right - left, bottom - top
                )
                whole.append(1000 * (time.process_time() - began))
    return [
        figure("a frame composed of parts", composed, "ms", higher_is_better=False),
        figure("its grid alone, rendered completely by resvg", whole, "ms", higher_is_better=False),
    ]
