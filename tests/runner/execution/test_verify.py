"""Verification names the first thing that is wrong: topic, episode, step, field, found and expected."""

from __future__ import annotations

import json
import os

import numpy as np
import pytest
from mcap.writer import Writer

from runner.config import from_mapping
from runner.config.model import Job
from runner.errors import RecordingError
from runner.execution.session import run_job
from runner.execution.verify import verify
from runner.recording import schema
from runner.recording.integrity import survey
from runner.recording.messages import decode, encode
from runner.recording.reader import open_recording
from runner.recording.repair import repair
from runner.recording.writer import RecordingFile
from runner.runs.run import create_run
from tests.runner.altering import altered
from tests.runner.recording.making import TAXIS, make_run, stopping_after


def setting(number: int, field: str, value: object):
    """Return the change that sets a field of one record."""

    def change(records):
        records[field][number] = value
        return records

    return change


def setting_in_message(number: int, **values: object):
    """Return the change that sets fields of one message of variable size."""

    def change_of(topic):
        def change(messages):
            time, payload = messages[number]
            messages[number] = time, encode(topic.message, decode(topic.message, payload) | values)
            return messages

        return change

    return change_of


def test_a_recording_is_sound(run):
    for rerun in (False, True):
        found = verify(run.recording, rerun=rerun)
        assert found.sound
        assert found.content_digest == run.summary["content_digest"]
        assert (found.train_steps, found.eval_steps) == (
            run.summary["train_steps"],
            run.summary["eval_steps"],
        )
        assert not found.notes
        assert not found.changes


def test_a_rewritten_recording_is_sound(run, tmp_path):
    assert verify(altered(run.recording, tmp_path / "x.mcap", None, id)).sound


@pytest.mark.parametrize(
    ("topic", "field", "value"),
    [
        (schema.TRAIN_STEP, "state", 7),
        (schema.TRAIN_STEP, "action", 35),
        (schema.TRAIN_STEP, "next_state", 1),
        (schema.TRAIN_STEP, "rewards", 99.0),
        (schema.TRAIN_STEP, "explored", 2),
        (schema.TRAIN_STEP, "terminated", True),
        (schema.EVAL_STEP, "rewards", -0.5),
        (schema.EVAL_STEP, "t", 900),
        (schema.TRAIN_EPISODE, "returns", 5.5),
        (schema.TRAIN_EPISODE, "length", 3),
        (schema.TRAIN_EPISODE, "success", False),
        (schema.EVAL_EPISODE, "penalties", 77),
        (schema.EVAL_EPISODE, "events", 9),
    ],
)
def test_one_field_of_one_record(run, tmp_path, topic, field, value):
    with open_recording(run.recording) as recording:
        records = recording.table(topic).array()
    number = next(k for k in range(len(records) // 3, len(records)) if np.all(records[field][k] != value))
    found = verify(altered(run.recording, tmp_path / "x.mcap", topic, setting(number, field, value)))
    assert not found.sound
    difference = found.difference
    assert (difference.topic, difference.field) == (topic.name, field)
    assert difference.episode == records["episode"][number]
    last = "step" if topic.message is schema.STEP else "last_step"
    assert difference.step == records[last][number]
    assert np.all(np.array(difference.found) == value)
    assert np.array_equal(difference.expected, records[field][number])
    for part in (topic.name, f"episode {difference.episode}", f"step {difference.step}", field, "expected"):
        assert part in found.finding


@pytest.mark.parametrize(
    ("topic", "field", "value"),
    [
        (schema.TRAIN_METRICS_TOPIC, "mean_length", 12.5),
        (schema.TRAIN_METRICS_TOPIC, "epsilon", 0.25),
        (schema.EVAL_METRICS_TOPIC, "success_percent", 99.5),
        (schema.EVAL_METRICS_TOPIC, "successes", 1000),
        (schema.EVAL_METRICS_TOPIC, "reward_counts", [1, 2]),
    ],
)
def test_one_figure(run, tmp_path, topic, field, value):
    change = setting_in_message(1, **{field: value})(topic)
    found = verify(altered(run.recording, tmp_path / "x.mcap", topic, change))
    with open_recording(run.recording) as recording:
        metrics = recording.phase(topic.phase).all_metrics()[1]
    difference = found.difference
    assert (difference.topic, difference.field) == (topic.name, field)
    assert (difference.found, difference.expected) == (value, metrics[field])
    assert (difference.episode, difference.step) == (metrics["episode"], metrics["step"])


@pytest.mark.parametrize("number", [0, 2, -1])
def test_one_cell_of_a_snapshot(run, tmp_path, number):
    with open_recording(run.recording) as recording:
        snapshot = list(recording.snapshots())[number]
    values = snapshot.values.copy()
    values[5, 3] += 1e-9
    change = setting_in_message(number, data=values.tobytes())(schema.Q_TABLE_TOPIC)
    found = verify(altered(run.recording, tmp_path / "x.mcap", schema.Q_TABLE_TOPIC, change))
    difference = found.difference
    assert (difference.topic, difference.field) == ("/q_table", "data[5, 3]")
    assert (difference.found, difference.expected) == (values[5, 3], snapshot.values[5, 3])
    assert (difference.episode, difference.step) == (snapshot.episode, snapshot.step)


@pytest.mark.parametrize(
    "topic",
    sorted(set(schema.JOB_TOPICS) - {schema.LOG_TOPIC}, key=lambda topic: topic.channel),
    ids=lambda topic: topic.name,
)
@pytest.mark.parametrize("change", [lambda m: m[:-1], lambda m: m[:0]], ids=["one missing", "all missing"])
def test_missing_messages(run, tmp_path, topic, change):
    found = verify(altered(run.recording, tmp_path / "x.mcap", topic, change))
    assert found.difference.topic == topic.name
    assert found.difference.found == "none"


@pytest.mark.parametrize("topic", schema.JOB_TOPICS[4:7], ids=lambda topic: topic.name)
def test_messages_too_many(run, tmp_path, topic):
    found = verify(altered(run.recording, tmp_path / "x.mcap", topic, lambda m: [*m, m[-1]]))
    assert found.difference.topic == topic.name
    assert found.difference.found == "more"


def test_another_seed_or_configuration(run, tmp_path):
    found = verify(altered(run.recording, tmp_path / "a.mcap", None, id, run=lambda run: run | {"seed": "1"}))
    assert "metadata run: job" in found.finding

    def later(entries):
        return {"json": entries["json"].replace('"epsilon": 0.4', '"epsilon": 0.5')}

    found = verify(altered(run.recording, tmp_path / "b.mcap", None, id, config=later))
    assert "metadata run: job" in found.finding


def test_a_changed_result(run, tmp_path):
    for key, value in (("content_digest", "0" * 64), ("train_steps", 1), ("last_evaluation", None)):

        def change(entries, key=key, value=value):
            return {"json": json.dumps(json.loads(entries["json"]) | {key: value})}

        found = verify(altered(run.recording, tmp_path / f"{key}.mcap", None, id, result=change))
        assert (found.difference.topic, found.difference.field) == ("metadata result", key)


def test_a_result_of_an_older_version_has_no_mean_return(run, tmp_path):
    def change(entries):
        result = json.loads(entries["json"])
        del result["last_evaluation"]["mean_return"]
        return {"json": json.dumps(result)}

    assert verify(altered(run.recording, tmp_path / "older.mcap", None, id, result=change)).difference is None


def test_cut_off(run, tmp_path):
    path = tmp_path / "x.mcap"
    path.write_bytes(run.recording.read_bytes())
    os.truncate(path, int(0.8 * path.stat().st_size))
    found = verify(path)
    assert found.verdict == "interrupted"
    assert "repair" in found.notes[0]
    assert found.difference is None
    assert 0 < found.train_steps <= run.summary["train_steps"]
    repair(path)
    found = verify(path)
    assert found.verdict == "interrupted"
    assert not found.notes


def test_a_recording_that_was_cut_off_before_its_first_messages_is_not_wrong(run, tmp_path):
    data = run.recording.read_bytes()
    first = survey(run.recording).chunks[0].offset
    for end in (first, first - 1, first + 1, first + 100):
        (tmp_path / "cut.mcap").write_bytes(data[:end])
        found = verify(tmp_path / "cut.mcap")
        assert (found.verdict, found.finding, found.steps) == ("interrupted", "", 0), end


def test_an_interrupted_recording_is_compared_to_its_end(run, tmp_path):
    path, cut = tmp_path / "x.mcap", tmp_path / "cut.mcap"
    cut.write_bytes(run.recording.read_bytes())
    os.truncate(cut, int(0.8 * cut.stat().st_size))
    repair(cut)
    with open_recording(cut) as recording:
        assert "result" not in survey(cut, keep_result=True).metadata
        last = len(recording.train.all_metrics()) - 1
        counts = recording.train.steps.count(), recording.eval.steps.count()
    found = verify(cut)
    assert found.sound, found.finding
    assert (found.train_steps, found.eval_steps) == counts
    change = setting_in_message(last, mean_length=0.5)(schema.TRAIN_METRICS_TOPIC)
    with open_recording(cut):
        found = verify(altered_without_result(cut, path, change))
    assert found.difference.field == "mean_length"


def test_a_changed_result_of_an_interrupted_run(run, tmp_path):
    job = Job(from_mapping(run.facts["config"]), run.seed)
    stopped = run_job(job, create_run(tmp_path, job.config, job.seed), stop=stopping_after(5))
    assert stopped.status == "interrupted"
    found = verify(stopped.recording)
    assert found.sound, found.finding
    assert found.content_digest == stopped.summary["content_digest"]
    for key, value in (("content_digest", "0" * 64), ("train_steps", 1)):

        def change(entries, key=key, value=value):
            return {"json": json.dumps(json.loads(entries["json"]) | {key: value})}

        found = verify(altered(stopped.recording, tmp_path / f"{key}.mcap", None, id, result=change))
        assert (found.difference.topic, found.difference.field) == ("metadata result", key)


def altered_without_result(source, target, change):
    """Alter the reports of training in a recording that has no result."""
    data = source.with_suffix(".finished")
    data.write_bytes(source.read_bytes())
    contents = survey(data, keep_result=True)
    with RecordingFile(data, contents=contents) as file:
        file.finish({"json": "{}"})
    return altered(data, target, schema.TRAIN_METRICS_TOPIC, change)


def test_damage_is_placed(run, tmp_path):
    path = tmp_path / "x.mcap"
    chunks = [part for part in survey(run.recording).chunks if part.channel == schema.TRAIN_STEP.channel]
    data = bytearray(run.recording.read_bytes())
    data[chunks[2].offset + 200] ^= 1
    path.write_bytes(data)
    found = verify(path)
    assert not found.sound
    first = sum(part.messages for part in chunks[:2])
    assert f"chunk at {chunks[2].offset}" in found.finding
    assert f"/train/step: step {first} is the first that cannot be read" in found.finding
    assert repair(path).lost == {"/train/step": [[first, first + chunks[2].messages]]}
    found = verify(path)
    assert f"/train/step: found none of number {first} to {first + chunks[2].messages - 1}" in found.finding
    assert "resume" in found.finding


def test_a_table_taken_over_is_part_of_it(tmp_path):
    source = make_run(tmp_path, TAXIS)
    run = make_run(tmp_path, TAXIS, initial_q={"run": source.run_id}, episodes=6, seed=1)
    assert verify(run.recording).sound
    with open_recording(run.recording) as recording:
        first = next(recording.snapshots())
    assert first.values.any()


def test_other_files_are_no_recordings(tmp_path):
    path = tmp_path / "other.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        writer.finish()
    for text, wrong in ((None, "profile 'ros2'.*not a dualtaxi recording"), (b"hello", "not a dualtaxi")):
        if text is not None:
            path.write_bytes(text)
        with pytest.raises(RecordingError, match=wrong):
            verify(path)
    path.write_bytes(b"")
    with pytest.raises(RecordingError, match="found an empty file"):
        verify(path)
    with pytest.raises(RecordingError, match="cannot be read"):
        verify(tmp_path / "missing.mcap")
    with pytest.raises(RecordingError, match="cannot be read"):
        verify(tmp_path)


def test_a_closed_recording_with_a_damaged_length_is_not_taken_for_an_interrupted_one(lake, tmp_path):
    """The length of the record before the first chunk is made so large that the walk ends there."""
    data = bytearray(lake.recording.read_bytes())
    length = data.index(b"provenance") - 4 - 8
    data[length + 4] ^= 1
    path = tmp_path / "changed.mcap"
    path.write_bytes(data)
    found = verify(path)
    assert found.verdict == "damaged"
