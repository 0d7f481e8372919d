"""A disk that is full in the middle of a loop: what is in the file belongs together."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from runner.execution.verify import verify
from runner.recording.reader import open_recording
from runner.runs.run import list_runs
from tests.runner.loops.making import dualtaxi

LOOP = """
import resource, sys, gymnasium, runner
from gymnasium.vector import SyncVectorEnv
from tests.runner.loops.making import Rooms

folder, kind, limit = sys.argv[1], sys.argv[2], int(sys.argv[3])
make = {
    "arrays": lambda: gymnasium.make("CartPole-v1"),
    "texts": lambda: Rooms(with_text=True),
    "vectors": lambda: SyncVectorEnv([lambda: gymnasium.make("CartPole-v1")] * 4),
}[kind]
record = runner.record_vector if kind == "vectors" else runner.record
rec = record(make(), folder, name=kind, chunk_steps=256)
rec.action_space.seed(0)
rec.reset(seed=0)
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
try:
    while True:
        terminated, truncated = rec.step(rec.action_space.sample())[2:4]
        if kind != "vectors" and (terminated or truncated):
            rec.reset()
except runner.RunnerError as error:
    print(error)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="limits the size of files")
@pytest.mark.parametrize("kind", ["arrays", "texts", "vectors"])
def test_all_steps_in_the_file_have_their_resets_and_episodes(tmp_path, kind):
    command = [sys.executable, "-c", LOOP, str(tmp_path), kind, "1000000"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert "writing failed (File too large)" in done.stdout, done.stderr
    (run,) = list_runs(tmp_path)
    assert run.status == "failed"
    assert "File too large" in dualtaxi(tmp_path, "show", run.run_id).output
    with open_recording(run.recording) as recording:
        assert recording.train.steps.total() > 2_000
        assert recording.train.whole_steps() == recording.train.steps.total()
        steps = np.concatenate(list(recording.train.steps.rows()))
        ended = int(np.count_nonzero(steps["terminated"] | steps["truncated"]))
        assert recording.train.episodes.count() >= ended
    found = verify(run.recording, sample=3)
    assert (found.sound, found.cut_off) == (True, 0)
