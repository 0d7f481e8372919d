"""Films of 500 steps: of a scene, of recorded frames, and drawn again, in every format."""

from __future__ import annotations

import statistics
import tempfile
from collections import deque
from pathlib import Path

import gymnasium

import runner
from benchmarks.figures import Figure, figure, seconds
from runner.export.film import FORMATS, Shot, captioned, write_film
from runner.export.pictures import Pictures
from runner.recording.reader import Recording, open_recording
from runner.runs.run import Run

STEPS = 500


def measure(quick: bool) -> list[Figure]:
    """Return the time of films of several sources and formats, and of their parts."""
    repetitions = 1 if quick else 5
    figures = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder)
        runs = {
            "a scene": scene(path),
            "recorded frames": pole(path, 1),
            "drawn again": pole(path, 0),
        }
        for name, run in runs.items():
            with open_recording(run.recording) as recording:
                for ending in FORMATS if name == "drawn again" else (".mp4",):
                    figures += film(recording, path / f"film{ending}", name, repetitions)
    return figures


def scene(folder: Path) -> Run:
    """Return a run whose first episode has that many steps."""
    limit = {"max_episode_steps": STEPS}
    config = {"name": "scene", "mode": "cooperative", "env": {"kwargs": limit}, "episodes": 5, "seed": 0}
    return runner.run(config, recordings=folder)


def pole(folder: Path, frames_every: int) -> Run:
    """Return a loop over CartPole whose first episode has that many steps."""
    env = gymnasium.make("CartPole-v1", render_mode="rgb_array")
    with runner.record(env, folder, frames_every=frames_every) as rec:
        observation, over = rec.reset(seed=0)[0], False
        while not over:
            position, speed, angle, turn = observation
            balanced = angle + 0.3 * turn + 0.05 * position + 0.1 * speed > 0
            observation, _, terminated, truncated, _ = rec.step(int(balanced))
            over = terminated or truncated
    return rec.run


def film(recording: Recording, path: Path, name: str, repetitions: int) -> list[Figure]:
    """Return the time of a film of the first episode, and in its detail those of drawing and captions."""

    def shot() -> Shot:
        return Shot("training episode 0", Pictures(recording, "train", 0))

    whole, drawn, captions = [], [], []
    for _ in range(repetitions):
        drawn.append(seconds(lambda: deque(shot().pictures, maxlen=0)))
        captions.append(seconds(lambda: deque(captioned(shot(), None), maxlen=0)) - drawn[-1])
        whole.append(seconds(lambda: write_film(path, shot(), 30, None, lambda _: None)))
    detail = f"pictures {statistics.median(drawn):.2f} s, captions {statistics.median(captions):.2f} s"
    what = f"{path.suffix[1:]} of {STEPS} steps, {name}"
    return [figure(what, whole, "s", (10, 4), higher_is_better=False, detail=detail)]
