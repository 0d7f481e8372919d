"""Films of 500 steps, from a scene and from recorded frames, in every format."""

from __future__ import annotations

import statistics
import tempfile
from collections import deque
from pathlib import Path

import gymnasium
import numpy as np

import runner
from benchmarks.figures import Figure, figure, seconds
from runner.export.film import FORMATS, Shot, captioned, write_film
from runner.export.pictures import pictures
from runner.recording.reader import Recording, open_recording
from runner.runs.run import Run

STEPS = 500


def measure(quick: bool) -> list[Figure]:
    """Return the time of films of several sources and formats, and of their parts."""
    repetitions = 1 if quick else 5
    figures = []
    with tempfile.TemporaryDirectory() as folder:
        for name, run in (("scene", scene(Path(folder))), ("frames", frames(Path(folder)))):
            with open_recording(run.recording) as recording:
                endings = FORMATS if name == "frames" else (".mp4",)
                figures += [
                    each
                    for ending in endings
                    for each in film(recording, Path(folder, f"film{ending}"), name, repetitions)
                ]
    return figures


def scene(folder: Path) -> Run:
    """Return a run whose first episode has that many steps."""
    limit = {"max_episode_steps": STEPS}
    config = {"name": "scene", "mode": "cooperative", "env": {"kwargs": limit}, "episodes": 5, "seed": 0}
    return runner.run(config, recordings=folder)


def frames(folder: Path) -> Run:
    """Return a loop over CartPole whose first episode has that many steps, each with a frame."""
    env = gymnasium.make("CartPole-v1", render_mode="rgb_array").unwrapped
    with runner.record(env, folder, name="frames", frames_every=1) as rec:
        rec.reset(seed=0)
        env.theta_threshold_radians = env.x_threshold = np.inf  # type: ignore[attr-defined]
        for step in range(STEPS):
            rec.step(step % 2)
    return rec.run


def film(recording: Recording, path: Path, name: str, repetitions: int) -> list[Figure]:
    """Return the time of a film of the first episode, and in its detail those of drawing and captions."""

    def shot() -> Shot:
        return Shot("training episode 0", pictures(recording, "train", 0))

    whole, drawn, captions = [], [], []
    for _ in range(repetitions):
        drawn.append(seconds(lambda: deque(shot().pictures, maxlen=0)))
        captions.append(seconds(lambda: deque(captioned(shot(), None, []), maxlen=0)) - drawn[-1])
        whole.append(seconds(lambda: write_film(path, shot(), fps=30)))
    detail = f"pictures {statistics.median(drawn):.2f} s, captions {statistics.median(captions):.2f} s"
    what = f"{path.suffix[1:]} of {STEPS} steps, {name}"
    return [figure(what, whole, "s", (10, 4), higher_is_better=False, detail=detail)]
