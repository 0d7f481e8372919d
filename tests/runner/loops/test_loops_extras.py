"""Values that a loop records with its steps: as given, by step, and the same after an archive."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pyarrow.parquet as pq
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from mcap.reader import make_reader
from mcap.records import MessageIndex
from mcap.stream_reader import StreamReader
from rerun.chunk import RrdReader

import runner
from runner.errors import ConfigError, RecordingError, RunnerError
from runner.execution.verify import verify
from runner.export.rerun.selection import Request
from runner.export.rerun.writing import export
from runner.recording import schema
from runner.recording.extras import ExtraNames
from runner.recording.layout import message_record
from runner.recording.messages import encode
from runner.recording.reader import Phase, open_recording
from runner.recording.records import ReadChunk, encode_chunk
from runner.recording.rewriting import whole_records
from runner.recording.steps import EpisodeSteps
from runner.recording.writer import RecordingFile
from runner.util.packing import Packing
from tests.runner.loops.making import Leaving, dualtaxi, make, play


class Tensor:
    """A tensor as PyTorch has them: to NumPy only after `detach` and `cpu`."""

    def __init__(self, values, is_plain=False):
        self._values, self._is_plain = np.asarray(values), is_plain
        self.dtype = self._values.dtype

    def detach(self):
        return Tensor(self._values, self._is_plain)

    def cpu(self):
        return Tensor(self._values, is_plain=True)

    def __array__(self, dtype=None, copy=None):
        if not self._is_plain:
            raise TypeError("can't convert a CUDA tensor that requires grad to numpy")
        return self._values


def record_pole(folder, steps=600, **options):
    """Record a loop with a value and logits at each step, an error at some, and evaluation steps."""
    draws, seen = np.random.default_rng(0), []
    with runner.record(make("CartPole-v1"), folder, name="pole", **options) as rec:
        rec.reset(seed=0)
        for k in range(steps):
            values = {"value": draws.normal(), "logits": draws.normal(size=2).astype(np.float32)}
            over = any(rec.step(k % 2, extras=values)[2:4])
            if k > steps // 3 and k % 3 == 0:
                values["td error"] = np.float32(draws.normal())
                rec.note_step({"td error": values["td error"]})
            seen.append(values)
            if k == steps // 2:
                with rec.phase("eval"):
                    rec.reset()
                    for _ in range(4):
                        rec.step(0, extras={"value": 2.5})
            if over or k == steps // 2:
                rec.reset()
    return rec.run, seen


def test_extras_come_back_as_they_were_given_and_mark_the_steps_without(tmp_path):
    run, seen = record_pole(tmp_path)
    with runner.open_recording(run.recording) as recording:
        extras = recording.train.extras
        kinds = {name: (kind.base.name, kind.shape) for name, kind in extras.items()}
        assert kinds == {
            "value": ("float64", ()),
            "logits": ("float32", (2,)),
            "td error": ("float32", ()),
        }
        found = extras.at(np.arange(len(seen)))
        for name, values in found.items():
            missing = np.ma.getmaskarray(values).reshape(len(seen), -1)[:, 0]
            assert [name in each for each in seen] == (~missing).tolist()
            given = [each[name] for each in seen if name in each]
            np.testing.assert_array_equal(values.data[~missing], given)
        evaluated = recording.eval.extras.of_episode(0)["value"]
        assert evaluated.tolist() == [2.5] * 4
        steps = recording.train.episode_steps(3)["step"]
        assert recording.train.extras.of_episode(3)["value"].tolist() == [seen[k]["value"] for k in steps]


def test_a_recording_with_extras_is_verified_archived_and_exported_with_the_same_content(tmp_path):
    run, seen = record_pole(tmp_path / "recordings")
    assert verify(run.recording).finding == ""
    assert {"/extra", "/train/extra", "/eval/extra"} <= set(run.summary.topic_digests)
    shown = dualtaxi(tmp_path / "recordings", "show", "pole").output
    assert "td error" in shown
    assert "float32 [2]" in shown
    archived = dualtaxi(
        tmp_path / "recordings", "archive", "pole", "--to", str(tmp_path / "archive"), "--remove"
    )
    assert archived.exit_code == 0, archived.output
    table = next(tmp_path.glob("archive/*/extras.parquet"))
    columns = pq.read_table(table)
    assert columns.column_names[4:] == ["extra_value", "extra_logits_0", "extra_logits_1", "extra_td error"]
    without = len(seen) + 4 - sum("td error" in values for values in seen)
    assert columns.column("extra_td error").null_count == without
    restored = dualtaxi(tmp_path / "recordings", "restore", "pole")
    assert restored.exit_code == 0, restored.output
    assert verify(run.recording).content_digest == run.summary.content_digest
    pd = pytest.importorskip("pandas")
    frame = runner.frames.steps(run, episode=0)
    assert frame["extra.value"].tolist() == [each["value"] for each in seen[: len(frame)]]
    assert pd.isna(frame["extra.td error"]).all()
    exported = dualtaxi(tmp_path / "recordings", "export", "csv", "pole", "-o", str(tmp_path / "csv"))
    assert exported.exit_code == 0, exported.output
    assert len((tmp_path / "csv/extras.csv").read_text().splitlines()) == 1 + len(seen) + 4


def test_rerun_has_extras_on_the_timeline_as_lines_or_as_bars(tmp_path):
    with runner.record(make("CartPole-v1"), tmp_path) as rec:
        for k, entry in enumerate(play(rec, 30)):
            if entry[0] == "step":
                rec.note_step(logits=np.array([k, -k]), histogram=np.full(20, k))
    path = tmp_path / "run.rrd"
    with runner.open_recording(rec.run.recording) as recording:
        export([rec.run], Request(everything=True), path)
        steps = next(recording.train.extras.blocks())["step"]
    chunks = RrdReader(str(path)).store().stream().to_chunks()
    rows = {"logits": [], "histogram": []}
    for chunk in chunks:
        name = str(chunk.entity_path).rpartition("/")[2]
        if not chunk.is_static and name in rows and "/extra/" in str(chunk.entity_path):
            rows[name] += chunk.to_record_batch().column("step").to_pylist()
    assert sorted(rows["logits"]) == sorted(rows["histogram"]) == (steps + 1).tolist()


def test_the_same_loop_gives_the_same_digest_and_one_without_extras_keeps_its_own(tmp_path):
    first, again = (record_pole(tmp_path)[0].summary.content_digest for _ in range(2))
    assert first == again
    plain = []
    for with_extras in (False, True):
        with runner.record(make("CartPole-v1"), tmp_path) as rec:
            for k, entry in enumerate(play(rec, 5000)):
                if with_extras and entry[0] == "step":
                    rec.note_step(k=k)
        plain.append(dict(rec.run.summary.topic_digests))
    assert plain[0].items() < plain[1].items()
    assert set(plain[1]) - set(plain[0]) == {"/extra", "/train/extra"}


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_extras_of_a_vector_belong_to_their_environment(tmp_path, mode):
    envs = SyncVectorEnv([lambda: gymnasium.make("CartPole-v1")] * 3, autoreset_mode=mode)
    with runner.record_vector(envs, tmp_path) as rec:
        rec.reset(seed=0)
        for k in range(90):
            over = np.logical_or(*rec.step(np.zeros(3, int), extras={"own": 10 * k + np.arange(3)})[2:4])
            rec.note_step(late=np.full((3, 2), k, np.float32))
            if mode == AutoresetMode.DISABLED and over.any():
                rec.reset(options={"reset_mask": over})
    assert verify(rec.run.recording).finding == ""
    with runner.open_recording(rec.run.recording) as recording:
        steps = recording.train.episode_steps(2)["step"]
        found = recording.train.extras.of_episode(2)
        assert found["own"].tolist() == [10 * (k // 3) + k % 3 for k in steps.tolist()]
        assert found["late"][:, 1].tolist() == [k // 3 for k in steps.tolist()]


def test_extras_of_agents_are_named_by_agent_and_those_that_left_have_none(tmp_path):
    with runner.record_parallel(Leaving(), tmp_path) as rec:
        for _ in range(2):
            rec.reset()
            while rec.agents:
                there = list(rec.agents)
                rec.step(dict.fromkeys(there, 1), extras={agent: {"value": len(there)} for agent in there})
        with pytest.raises(ConfigError, match=r"found 'value': float, expected the values of each agent"):
            rec.note_step(value=1.0)
    assert verify(rec.run.recording).finding == ""
    with runner.open_recording(rec.run.recording) as recording:
        found = recording.train.extras.of_episode(1)
        assert {name: values.tolist() for name, values in found.items()} == {
            "a/value": [3, None, None],
            "b/value": [3, 2, None],
            "c/value": [3, 2, 1],
        }


def test_tensors_and_spaces_of_varying_size_have_extras_too(tmp_path):
    with runner.record(make("RoomsText"), tmp_path) as rec:
        for k, entry in enumerate(play(rec, 40)):
            if entry[0] == "step":
                rec.note_step(value=Tensor(np.float32(k)), flag=k % 2 == 0)
    assert verify(rec.run.recording).finding == ""
    with runner.open_recording(rec.run.recording) as recording:
        found = recording.train.extras.of_episode(0)
        assert found["value"].dtype == np.float32
        assert found["value"].tolist() == list(range(1, 1 + len(found["value"])))
        assert found["flag"].tolist() == [k % 2 == 0 for k in range(1, 1 + len(found["value"]))]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (
            {"value": np.zeros(2)},
            r"found float64 of shape \(2,\) for 'value', expected float32 of shape \(\)",
        ),
        ({"value": 0.5}, "found float64 of shape"),
        ({"value": "text"}, r"found str for 'value', expected float32 of shape \(\)"),
        ({"other": object()}, "expected a number or an array"),
        ({"other": {"inner": 1}}, "expected a number or an array"),
        ({"": 1}, "expected text of 1 to 200 letters"),
        ({"x" * 201: 1}, "expected text of 1 to 200 letters"),
        ({"other": np.zeros((2, 0))}, "a number at least"),
        ({"other": []}, "found an empty list as the first value"),
        ({"other": "x" * (1 << 20)}, "expected at most 1,048,576"),
        ({"other": np.zeros(1 << 20)}, "expected at most 1,048,576"),
        ({str(k): k for k in range(256)}, "found more than 256 names"),
    ],
)
def test_what_does_not_fit_is_refused_with_the_reason_and_the_step_stays(tmp_path, values, message):
    with runner.record(make("CartPole-v1"), tmp_path) as rec:
        rec.reset(seed=0)
        rec.step(0, extras={"value": np.float32(1)})
        with pytest.raises(ConfigError, match=message):
            rec.step(0, extras=values)
        rec.step(0, extras={"value": np.float32(2)})
    assert verify(rec.run.recording).finding == ""
    with runner.open_recording(rec.run.recording) as recording:
        assert recording.train.extras.of_episode(0)["value"].tolist() == [1, None, 2]


def test_only_the_last_step_of_the_phase_can_be_extended(tmp_path):
    with runner.record(make("CartPole-v1"), tmp_path) as rec:
        rec.reset(seed=0)
        with pytest.raises(RunnerError, match="note_step"):
            rec.note_step(value=1.0)
        rec.step(0)
        with rec.phase("eval"):
            rec.reset()
            rec.step(0)
        with pytest.raises(RunnerError, match="note_step"):
            rec.note_step(value=1.0)
        rec.reset()
        with pytest.raises(RunnerError, match="note_step"):
            rec.note_step(value=1.0)
    with pytest.raises(RunnerError, match="closed"):
        rec.note_step(value=1.0)


KILLED = """
import sys, time
import gymnasium, runner
rec = runner.record(gymnasium.make("CartPole-v1"), sys.argv[1])
rec.reset(seed=0)
for k in range(10**9):
    over = any(rec.step(k % 2, extras={"k": k})[2:4])
    if over:
        rec.reset()
    if k == 3000:
        time.sleep(1.5)
        print("ready", flush=True)
        time.sleep(60)
"""


def test_extras_are_sound_where_the_steps_were_left_out(tmp_path):
    with runner.record(gymnasium.make("CartPole-v1"), tmp_path, steps="none") as rec:
        rec.reset(seed=1)
        for step in range(5):
            rec.step(step % 2, extras={"value": step / 2})
    found = verify(rec.run.recording)
    assert found.sound, found.finding
    with open_recording(rec.run.recording) as recording:
        (block,) = recording.train.extras.blocks()
    assert block["values"]["value"].tolist() == [0.0, 0.5, 1.0, 1.5, 2.0]


def test_a_killed_loop_keeps_its_extras_and_a_repair_too(tmp_path):
    command = [sys.executable, "-c", KILLED, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"ready\n"
        process.kill()
    run = next(tmp_path.iterdir()).name
    for command in ("repair", "verify"):
        done = dualtaxi(tmp_path, command, run)
        assert done.exit_code == 0, done.output
    with runner.open_recording(next(tmp_path.glob("*/recording.mcap"))) as recording:
        blocks = list(recording.train.extras.blocks())
        found = np.concatenate([block["values"]["k"] for block in blocks])
        assert found.tolist() == list(range(len(found)))
        assert len(found) >= 3000


def test_extras_are_found_although_their_message_indexes_have_no_entries(tmp_path):
    run, _ = record_pole(tmp_path, 9000)
    with run.recording.open("rb") as stream:
        records = StreamReader(stream, emit_chunks=True).records
        indexes = [record for record in records if isinstance(record, MessageIndex)]
        own = [index.records for index in indexes if index.channel_id == schema.TRAIN_EXTRA.channel]
        assert own
        assert not any(own)
        stream.seek(0)
        reader = make_reader(stream)
        assert sum(1 for _ in reader.iter_messages(topics=["/train/extra"])) == 9000
    (tmp_path / "cut.mcap").write_bytes(run.recording.read_bytes()[:-9000])  # without its summary
    with runner.open_recording(tmp_path / "cut.mcap") as recording:
        assert len(recording.train.extras) == 3


def test_forged_names_are_refused(tmp_path):
    run, _ = record_pole(tmp_path, 40)
    for text in (
        '{"type": "Dict", "spaces": {}}',
        "[]",
        '{"type": "Dict", "spaces": {"a": {"type": "Text"}}}',
    ):
        path = Path(tmp_path, "forged.mcap")
        path.unlink(missing_ok=True)
        forge(run.recording, path, encode(schema.EXTRA_COLUMNS, {"json": text}))
        with runner.open_recording(path) as recording, pytest.raises(RecordingError, match="names of extras"):
            _ = recording.train.extras


def forge(source: Path, path: Path, payload: bytes) -> None:
    """Copy a recording with another message in place of the names of its extras."""
    with runner.open_recording(source) as recording:
        layout = recording.layout
    names = ExtraNames("it")
    with RecordingFile(path, layout) as file:
        for record in whole_records(source):
            if isinstance(record, ReadChunk) and record.topic is schema.EXTRA_COLUMNS_TOPIC:
                names.take(record)
                names.declare(file)
                message = message_record(record.topic, int(record.times[0]), payload)
                times, offsets = record.times[:1], record.offsets[:1]
                file.add_chunk(encode_chunk(record.topic, message, times, offsets, Packing()))
            else:
                file.copy(record)
        file.finish()


def test_an_episode_too_long_for_arrays_is_refused_before_its_steps_are_numbered(tmp_path, monkeypatch):
    record_pole(tmp_path, steps=50)

    def endless(phase, _):
        return EpisodeSteps(phase.steps, 0, 10**12 - 1, 10**12)

    monkeypatch.setattr(Phase, "episode", endless)
    (path,) = tmp_path.glob("*/recording.mcap")
    with open_recording(path) as recording, pytest.raises(RecordingError, match="read them in blocks"):
        recording.train.extras.of_episode(0)
