"""Archives of users' own loops: everything is restored, and columns have all values."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv

import runner
from runner.archive import layout, places
from runner.archive.layout import Manifest, entries_of, read_manifest
from runner.archive.reading import restore
from runner.errors import RecordingError
from runner.execution.verify import verify
from runner.recording import schema
from runner.recording.integrity import check_integrity
from runner.recording.reader import open_recording
from tests.runner.altering import altered
from tests.runner.archive.whole import archived, contents
from tests.runner.loops.making import make, play


class Odd(gymnasium.Env):
    """Values that columns could get wrong: NaN and -0, halves, large numbers, an image, names that clash."""

    observation_space = spaces.Dict(
        {
            "a_0_1": spaces.Box(-1, 1, (), np.float16),
            "a": spaces.Box(-np.inf, np.inf, (2, 2), np.float64),
            "image": spaces.Box(0, 255, (9, 8, 3), np.uint8),
            "none": spaces.Box(0, 1, (0,), np.float32),
            "far": spaces.Box(0, 2**64 - 1, (2,), np.uint64),
        }
    )
    action_space = spaces.MultiBinary(3)
    metadata = {"render_modes": []}  # noqa: RUF012 - as Gymnasium has it

    def _seen(self):
        rng = self.np_random
        return {
            "a_0_1": np.float16(rng.random()),
            "a": np.array([[np.nan, -0.0], [-np.nan, rng.normal()]]),
            "image": rng.integers(0, 256, (9, 8, 3)).astype(np.uint8),
            "none": np.zeros(0, np.float32),
            "far": np.array([2**64 - 1, rng.integers(5)], np.uint64),
        }

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._seen(), {}

    def step(self, action):
        return self._seen(), float("nan"), False, bool(self.np_random.random() < 0.1), {}


def with_everything(env, folder, **options):
    """Record a loop that uses all there is."""
    info = ["luck", "way", "prob"]
    with runner.record(env, folder, info=info, config={"lr": 0.1}, **options) as rec:
        for number, _ in enumerate(play(rec, 90)):
            if number % 20 == 0:
                rec.log("loss", float("nan") if number == 40 else -number / 3)
                rec.log("note", f"number {number}: ä\n")
                rec.snapshot("weights", np.full((2, 0, 3) if number else (2, 3), number, np.int16))
        rec.reset(seed=2**70 if isinstance(env.unwrapped, Odd) else 3, options={"way": "back"})
        with rec.phase("eval"):
            for _ in play(rec, 30):
                pass
            rec.log("score", 2.5)
    return rec.run.recording


def games(folder):
    """Record a game of two agents that do not always both act."""
    from dualtaxi.parallel import DualTaxiParallelEnv

    with runner.record_parallel(DualTaxiParallelEnv(max_steps=12), folder) as rec:
        for episode in range(4):
            rec.reset(seed=episode)
            while rec.agents:
                rec.step({agent: rec.action_space(agent).sample() for agent in rec.agents})
    return rec.run.recording


def vectors(name):
    def make_them(folder):
        with runner.record_vector(SyncVectorEnv([lambda: make(name)] * 3), folder) as rec:
            rec.action_space.seed(1)
            rec.reset(seed=1)
            for _ in range(120):
                rec.step(rec.action_space.sample())
        return rec.run.recording

    return make_them


LOOPS = {
    "steps": lambda folder: with_everything(make("Taxi-v4"), folder),
    "joint": lambda folder: with_everything(make("dualtaxi:DualTaxi-v1"), folder),
    "not tabular": lambda folder: with_everything(make("Blackjack-v1"), folder),
    "pole": lambda folder: with_everything(make("CartPole-v1"), folder, chunk_steps=256, index="chunk"),
    "rooms": lambda folder: with_everything(make("Rooms"), folder, frames_every=7),
    "texts": lambda folder: with_everything(make("RoomsText"), folder, frames_every=9, compression="lz4"),
    "odd": lambda folder: with_everything(Odd(), folder, compression="none"),
    "vector": vectors("CartPole-v1"),
    "vector of texts": vectors("RoomsText"),
    "vector of steps": vectors("FrozenLake-v1"),
    "game": games,
}


@pytest.fixture(scope="module", params=list(LOOPS))
def loop(request, tmp_path_factory):
    """Return the recording of a loop, and its archive."""
    path = LOOPS[request.param](tmp_path_factory.mktemp("loops"))
    return path, archived(path, tmp_path_factory.mktemp("archives") / "archive")


def test_all_that_a_loop_recorded_comes_back(loop, tmp_path):
    path, folder = loop
    back = tmp_path / "back.mcap"
    manifest = restore(folder, back)
    assert contents(back) == contents(path)
    check_integrity(back)
    assert verify(back).sound
    with open_recording(path) as recording:
        assert manifest.digest == recording.result["content_digest"]
        assert set(manifest.topics) == {"/clock", *recording.result["messages"]}


def test_a_restored_loop_has_chunks_like_those_of_the_recorder(loop, tmp_path):
    path, folder = loop
    back = tmp_path / "back.mcap"
    restore(folder, back)
    with open_recording(back) as restored, open_recording(path) as recording:
        assert len(restored.file.index.chunks) <= len(recording.file.index.chunks)


def test_every_table_is_read_by_others(loop):
    import duckdb
    import polars as pl

    path, folder = loop
    with open_recording(path) as recording:
        messages = recording.result["messages"]
    counts = {
        layout.STEPS: "step",
        layout.EPISODES: "episode",
        layout.RESETS: "reset",
        layout.INFOS: "info",
        layout.SCALARS: "scalar",
        layout.ARRAYS: "array",
        layout.FRAMES: "frame",
        layout.LOG: "log",
    }
    for name, topic in counts.items():
        expected = sum(count for full, count in messages.items() if full.endswith(f"/{topic}"))
        file = folder / name
        assert pq.read_table(file).num_rows == expected
        assert len(pl.read_parquet(file)) == expected
        assert duckdb.execute(f"SELECT count(*) FROM '{file}'").fetchall() == [(expected,)]


def test_states_before_resets_are_restored(tmp_path):
    with runner.record(make("CartPole-v1"), tmp_path) as rec:
        rec.reset()
        for _ in range(1200):
            *_, terminated, truncated, _ = rec.step(rec.action_space.sample())
            if terminated or truncated:
                rec.reset()
    restore(archived(rec.run.recording, tmp_path / "archive"), tmp_path / "back.mcap")
    with open_recording(rec.run.recording) as recording, open_recording(tmp_path / "back.mcap") as restored:
        assert len(list(recording.train.reset_states())) == 2
        assert list(restored.train.reset_states()) == list(recording.train.reset_states())
        assert restored.maker == recording.maker


def test_a_run_of_several_processes_comes_back(tmp_path):
    with runner.record(make("CartPole-v1"), tmp_path) as rec:
        list(play(rec, 100, 1))
        with runner.record(make("CartPole-v1"), join=rec.run, shard="two") as two:
            list(play(two, 100, 2))
    restore(archived(rec.run.recording, tmp_path / "archive"), tmp_path / "back.mcap")
    assert contents(tmp_path / "back.mcap") == contents(rec.run.recording)
    with open_recording(tmp_path / "back.mcap") as restored:
        assert [shard.name for shard in restored.shards] == ["", "two"]
    assert verify(tmp_path / "back.mcap").sound


def test_every_number_of_an_observation_has_a_column(tmp_path):
    path = LOOPS["pole"](tmp_path)
    folder = archived(path, tmp_path / "archive")
    steps = pq.read_table(folder / layout.STEPS)
    assert steps["next_observation_2"].type == pa.float32()
    with open_recording(path) as recording:
        mine = {
            phase: steps.filter(pa.compute.equal(steps["phase"], phase)).to_pandas()
            for phase in ("train", "eval")
        }
        for phase, frame in mine.items():
            records = recording.phase(phase).steps.array()
            seen = frame[[f"next_observation_{i}" for i in range(4)]].to_numpy()
            np.testing.assert_array_equal(seen, records["next_observation"])
            np.testing.assert_array_equal(frame["action"], records["action"])
            np.testing.assert_array_equal(frame["t"], records["t"])
    resets = pq.read_table(folder / layout.RESETS).to_pandas()
    assert resets["seed"].dropna().tolist() == [5, 3, 5]
    assert resets["position"].is_monotonic_increasing
    scalars = pq.read_table(folder / layout.SCALARS).to_pandas()
    assert scalars.query("phase == 'eval'")[["name", "value"]].to_numpy().tolist() == [["score", 2.5]]
    assert pq.read_table(folder / layout.LOG)["name"].unique().to_pylist() == ["note"]
    run = pq.read_table(folder / layout.RUN).to_pylist()[0]
    assert (run["kind"], run["env_id"], run["environments"]) == ("loop", "CartPole-v1", 1)


def test_values_of_nested_spaces_are_named_by_their_path(tmp_path):
    texts = pq.read_table(archived(LOOPS["texts"](tmp_path), tmp_path / "archive") / layout.STEPS)
    names = set(texts.schema.names)
    assert {"next_observation_position_1", "next_observation_room_1_0", "action_go"} <= names
    assert all(isinstance(text, str) for text in texts["next_observation_mission"].to_pylist())
    odd = pq.read_table(archived(LOOPS["odd"](tmp_path), tmp_path / "other") / layout.STEPS)
    seen = [field for field in odd.schema if field.name.startswith("next_observation_")]
    assert [field.name for field in seen] == [f"next_observation_{i}" for i in range(1, 9)]
    assert seen[7].type == pa.binary(9 * 8 * 3)


def test_the_query_for_the_observation_before_a_step_answers(tmp_path, monkeypatch):
    import duckdb

    page = (Path(__file__).parents[3] / "docs" / "archive.md").read_text(encoding="utf-8")
    (query,) = re.findall(r"```sql\n(SELECT episode, t, action.*?)```", page, flags=re.DOTALL)
    path = LOOPS["pole"](tmp_path / "loops")
    (tmp_path / "archive").mkdir()
    archived(path, tmp_path / "archive" / "pole")
    monkeypatch.chdir(tmp_path)
    rows = duckdb.sql(query).fetchall()
    assert len(rows) == 120
    assert all((before is None) == (t == 0) for _, t, *_, before in rows)


def test_agents_have_columns_of_their_own(tmp_path):
    game = pq.read_table(archived(LOOPS["game"](tmp_path), tmp_path / "archive") / layout.STEPS)
    names = {"action_taxi_1", "action_taxi_2", "reward_taxi_2", "next_observation_taxi_1"}
    assert names <= set(game.schema.names)


def test_what_a_killed_loop_left_comes_back(tmp_path):
    path = LOOPS["texts"](tmp_path)
    with open_recording(path) as recording:
        chunks = recording.file.index.chunks
        cut = sum(chunks[len(chunks) - 3][:2])
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(path.read_bytes()[: cut + 11])
    restore(archived(torn, tmp_path / "archive"), tmp_path / "back.mcap")
    assert contents(tmp_path / "back.mcap") == contents(torn)


def test_a_message_that_no_recorder_writes_is_refused(tmp_path):
    path = LOOPS["texts"](tmp_path)

    def with_more(messages):
        return [(time, payload + b"\x98\x06\x01") for time, payload in messages]

    odd = altered(path, tmp_path / "odd.mcap", schema.TRAIN_STEP, with_more)
    with pytest.raises(RecordingError, match="no recorder writes"):
        archived(odd, tmp_path / "archive")


def test_memory_does_not_grow_with_the_size_of_values(tmp_path):
    """A table's groups, a restored chunk and a batch of rows are bounded by bytes, not by rows alone."""
    large = spaces.Box(0, 255, (300, 400, 3), np.uint8)

    class Camera(Odd):
        observation_space = large

        def _seen(self):
            return np.full((300, 400, 3), int(self.np_random.integers(256)), np.uint8)

    with runner.record(Camera(), tmp_path) as rec:
        for _ in play(rec, 150):
            pass
    folder = archived(rec.run.recording, tmp_path / "archive")
    about = pq.ParquetFile(folder / layout.STEPS).metadata
    assert about.num_row_groups > 1
    restore(folder)


@pytest.mark.skipif(sys.platform != "linux", reason="the memory limit is the system's")
def test_a_value_that_unpacks_to_more_than_the_memory_limit_is_refused(tmp_path, monkeypatch):
    """300 MB of zeros in one value, which take a few kilobytes in the file."""
    recording = with_everything(make("FrozenLake-v1"), tmp_path)
    folder = archived(recording, tmp_path / "archive")
    tables = pq.read_table(folder / layout.ARRAYS)
    data = pa.array([b"\0" * (300 << 20), *tables["data"].to_pylist()[1:]], pa.binary())
    place = tables.schema.get_field_index("data")
    bomb = tables.set_column(place, "data", data)
    pq.write_table(
        bomb, folder / layout.ARRAYS, compression="zstd", use_dictionary=False, write_statistics=False
    )
    assert (folder / layout.ARRAYS).stat().st_size < 1 << 20
    manifest = read_manifest((folder / layout.MANIFEST).read_bytes(), "")
    forged = Manifest(manifest.run, manifest.topics, entries_of(folder))
    (folder / layout.MANIFEST).write_bytes(forged.to_json())
    monkeypatch.setattr(places, "MEMORY_BYTES", 256 << 20)
    with pytest.raises(RecordingError, match=r"needs more than 268 MB of memory"):
        places.restore_to(folder, tmp_path / "back.mcap", manifest.digest, lambda _: None)
    assert not (tmp_path / "back.mcap").exists()
    steps = []
    unharmed = archived(recording, tmp_path / "unharmed")
    places.restore_to(unharmed, tmp_path / "back.mcap", manifest.digest, steps.append)
    assert steps[-1] == 120


class Speaker(gymnasium.Env):
    """An environment whose actions are text."""

    observation_space = spaces.Discrete(2)
    action_space = spaces.Text(8)
    metadata = {"render_modes": []}  # noqa: RUF012 - as in Gymnasium

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return 0, {}

    def step(self, action):
        return len(action) % 2, 1.0, len(action) > 2, False, {}


def test_actions_that_are_text_are_archived_and_restored(tmp_path):
    with runner.record(Speaker(), tmp_path / "recordings") as env:
        env.reset(seed=0)
        for word in ("a", "bc", "def"):
            env.step(word)
    restore(archived(env.run.recording, tmp_path / "archive"), tmp_path / "back.mcap")
    assert contents(tmp_path / "back.mcap") == contents(env.run.recording)
