"""Files of loops: read by other readers, repaired if damaged, refused if forged."""

from __future__ import annotations

import json
import subprocess
from collections import Counter
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import rerun_cli
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

import runner
from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.integrity import check_integrity
from runner.recording.reader import open_recording
from runner.recording.repair import repair
from runner.recording.rewriting import rewrite
from tests.runner.loops.making import Rooms, dualtaxi, make, play

NAMES = ("FrozenLake-v1", "CartPole-v1", "Rooms", "RoomsText")


@pytest.fixture(scope="session", params=NAMES)
def whole(request, tmp_path_factory):
    """Return the name of an environment and a recording of it with every topic."""
    folder = tmp_path_factory.mktemp("files")
    env = make(request.param)
    options = {"frames_every": 50} if request.param.startswith("Rooms") else {}
    with runner.record(env, folder, info=["prob", "luck", "first"], chunk_steps=256, **options) as rec:
        list(play(rec, 1000))
        rec.log("loss", 0.5)
        rec.log("note", "text")
        rec.snapshot("q", np.eye(3))
        with rec.phase("eval"):
            list(play(rec, 300))
    return request.param, rec.run.recording


def test_the_official_reader_reads_every_message(whole):
    name, path = whole
    counts: Counter[str] = Counter()
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        first = None
        for message in reader.iter_decoded_messages():
            counts[message.channel.topic] += 1
            if message.channel.topic == "/train/step" and first is None:
                first = message.decoded_message
    with open_recording(path) as recording:
        assert recording.has_states == (name == "FrozenLake-v1")
        assert counts.pop("/clock") >= 2  # where it began, and where it ended
        counts.pop("/host", None)  # of a loop that takes over a second
        assert dict(counts) == recording.result["messages"]
        one = next(recording.train.transitions())
    assert first.step == 0
    assert list(first.rewards) == one["rewards"].tolist()
    assert set(counts) <= {topic.name for topic in schema.KINDS["loop"]}
    if name == "CartPole-v1":
        assert first.action == one["action"]
        assert list(first.next_observation) == one["next_observation"].tolist()


def test_rerun_verifies_the_recording(whole):
    program = Path(rerun_cli.__file__).parent / "rerun"
    done = subprocess.run([program, "mcap", "check", whole[1]], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_damaged_chunk_is_reported_and_the_rest_is_read(whole, tmp_path):
    name, path = whole
    damaged = tmp_path / "recording.mcap"
    data = bytearray(path.read_bytes())
    with open_recording(path) as recording:
        topic = recording.table("/train/step").topic
        before = recording.table(topic).count()
        entry = recording.table(topic).entry(1 if name != "RoomsText" else 0)
    at = entry.offset + entry.length - 40
    data[at : at + 8] = b"\xff" * 8
    damaged.write_bytes(data)
    done = repair(damaged)
    check_integrity(damaged)
    assert not done.lossless
    with open_recording(damaged) as recording:
        kept = [int(step["step"]) for step in recording.train.transitions()]
        assert before - len(kept) > 0 or name == "RoomsText"
        if name != "RoomsText":
            ((start, stop),) = recording.lost["/train/step"]
            assert kept == [k for k in range(before) if not start <= k < stop]
        assert recording.eval.steps.count() == 300


@pytest.fixture(scope="session")
def pole(tmp_path_factory):
    """Return a recording of arrays."""
    with runner.record(make("CartPole-v1"), tmp_path_factory.mktemp("pole")) as rec:
        list(play(rec, 300))
    return rec.run.recording


def altered(path: Path, tmp_path: Path, **metadata: str) -> Path:
    """Return a copy with other metadata of the run."""
    made = tmp_path / "made-up.mcap"

    def change(name: str, entries: dict[str, str]) -> dict[str, str]:
        return entries | metadata if name == "run" else entries

    rewrite(path, made, change)
    return made


@pytest.mark.parametrize(
    ("metadata", "message"),
    [
        ({"kind": "other"}, "kind"),
        ({"kind": "job"}, "not written by dualtaxi"),
        ({"environments": "0"}, "environments"),
        ({"environments": "many"}, "environments"),
        ({"spaces": "[]"}, "space"),
        ({"spaces": "{}"}, "space"),
        ({"spaces": '{"observation": {"type": "Dict", "spaces": []}}'}, "describes no space"),
        ({"spaces": json.dumps({"observation": {"type": "Box"}, "action": {"type": "Text"}})}, "space"),
        (
            {
                "spaces": json.dumps(
                    {
                        "observation": {"type": "Box", "dtype": "|O8", "shape": [2]},
                        "action": {"type": "Discrete", "dtype": "<i8", "shape": []},
                    }
                )
            },
            "O8",
        ),
        (
            {
                "spaces": json.dumps(
                    {
                        "observation": {"type": "Box", "dtype": "<f8", "shape": [10**9, 10**9]},
                        "action": {"type": "Discrete", "dtype": "<i8", "shape": []},
                    }
                )
            },
            "shape",
        ),
    ],
    ids=lambda value: value if isinstance(value, str) else "-",
)
def test_false_metadata_is_refused(pole, tmp_path, metadata, message):
    with (
        pytest.raises(RecordingError, match=message),
        open_recording(altered(pole, tmp_path, **metadata)) as recording,
    ):
        for _ in recording.train.transitions():
            pass


def test_a_description_nested_without_end_is_refused(pole, tmp_path):
    deep = '{"type":"Tuple","spaces":[' * 40 + '{"type":"Text"}' + "]}" * 40
    made = altered(pole, tmp_path, spaces=f'{{"observation": {deep}, "action": {{}}}}')
    with pytest.raises(RecordingError, match="describes no space"), open_recording(made) as recording:
        _ = recording.layout


def test_csv_lists_the_omitted_columns(tmp_path):
    class Camera(Rooms):
        def __init__(self):
            super().__init__()
            self.observation_space = gymnasium.spaces.Box(0, 255, (8, 8, 3), np.uint8)

    with runner.record(Camera(), tmp_path / "loops", name="camera") as rec:
        list(play(rec, 20))
    done = dualtaxi(tmp_path / "loops", "export", "csv", "camera", "-o", str(tmp_path / "tables"))
    assert done.exit_code == 0
    assert "Left out, as CSV cannot hold bytes: next_observation, observation" in done.output
