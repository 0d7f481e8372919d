"""Texts, and arrays of varying length, that a loop records with its steps: token ids, log-probabilities."""

from __future__ import annotations

import shutil

import gymnasium
import numpy as np
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

import runner
from runner.errors import ConfigError
from runner.execution.verify import verify
from runner.recording import schema
from runner.recording.integrity import check_integrity
from runner.recording.reader import open_recording
from runner.recording.repair import repair
from tests.runner.loops import talking
from tests.runner.loops.making import Leaving, dualtaxi, make, play
from tests.runner.loops.talking import ENVIRONMENTS, said

STEPS = 60


def generated(draws, t):
    """Return tokens, log-probabilities and a value; often as many tokens as before, sometimes none."""
    n = (3, 3, 5, 0, 8)[t % 5]
    return {
        "tokens": draws.integers(0, 2**40, n),
        "logprobs": draws.normal(size=n).astype(np.float32),
        "value": float(draws.normal()),
    }


def stacked(values):
    """Return the values of environments by name, as a loop over a vector has them."""
    return {name: [own[name] for own in values] for name in values[0]}


def are_same(found, expected):
    """Return whether extras along steps are those that were given, bit for bit; None where none were."""
    return all(
        (value is None or value is np.ma.masked)
        if own is None
        else (np.asarray(value).dtype, np.asarray(value).tobytes(), np.shape(value))
        == (np.asarray(own).dtype, np.asarray(own).tobytes(), np.shape(own))
        for value, own in zip(found, expected, strict=True)
    )


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Record eight assistants at once; return the run, and what was given with each step."""
    draws, given = np.random.default_rng(3), []
    with runner.record_vector(
        talking.assistants(), tmp_path_factory.mktemp("eight"), name="eight", make=talking.assistants
    ) as rec:
        rec.reset(seed=5)
        for t in range(STEPS):
            values = [generated(draws, t + i) for i in range(ENVIRONMENTS)]
            rec.step(tuple(said(t, i) for i in range(ENVIRONMENTS)), extras=stacked(values))
            given += values
    return rec.run, given


def test_eight_at_once_are_read_back_bit_for_bit(recorded):
    run, given = recorded
    with open_recording(run.recording) as recording:
        extras = recording.train.extras
        assert {name: (kind.base.str, kind.shape) for name, kind in extras.items()} == {
            "tokens": ("|O", ()),
            "logprobs": ("|O", ()),
            "value": ("<f8", ()),
        }
        assert extras.columns["tokens"] == {"type": "Array", "dtype": "<i8", "shape": [None]}
        found = extras.at(np.arange(len(given)))
        for name, values in found.items():
            assert are_same(values, [own[name] for own in given])
        for episode in range(10):
            steps = recording.train.episode(episode).numbers()
            along = extras.of_episode(episode)
            assert are_same(along["tokens"], [given[k]["tokens"] for k in steps])
            assert along["tokens"].shape == (len(steps),)


def test_they_are_verified_and_replayed(recorded):
    run, _ = recorded
    assert verify(run.recording).finding == ""
    proved = dualtaxi(run.folder.parent, "verify", run.run_id, "--trust")
    assert proved.exit_code == 0, proved.output
    assert "reproduced: reran" in proved.output
    shown = dualtaxi(run.folder.parent, "show", run.run_id).output
    assert "int64 [T]" in shown
    assert "float32 [T]" in shown


def test_a_plain_reader_finds_them_by_name_with_their_types(recorded):
    run, given = recorded
    found = {name: [] for name in ("tokens", "logprobs", "value")}
    with run.recording.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, _, message, extra in reader.iter_decoded_messages(topics=["/train/extra"]):
            assert message.log_time == (extra.step + 1) * schema.STEP_NANOSECONDS
            assert (extra.given.tokens, extra.given.value) == (True, True)
            found["tokens"].append(list(extra.varying.tokens))
            found["logprobs"].append(list(extra.varying.logprobs))
            found["value"].append(extra.values.value)
    assert found["tokens"] == [own["tokens"].tolist() for own in given]
    assert found["logprobs"] == [own["logprobs"].tolist() for own in given]
    assert found["value"] == [own["value"] for own in given]


def test_they_come_back_from_an_archive_and_stand_in_tables(recorded, tmp_path):
    run, given = recorded
    folder = tmp_path / "recordings"
    shutil.copytree(run.folder.parent, folder)
    archived = dualtaxi(folder, "archive", run.run_id, "--to", str(tmp_path / "archive"), "--remove")
    assert archived.exit_code == 0, archived.output
    (table,) = tmp_path.glob("archive/*/extras.parquet")
    columns = pq.read_table(table)
    assert columns["extra_tokens"].to_pylist() == [own["tokens"].tolist() for own in given]
    restored = dualtaxi(folder, "restore", run.run_id)
    assert restored.exit_code == 0, restored.output
    (path,) = folder.glob("*/recording.mcap")
    assert verify(path).content_digest == run.summary.content_digest
    for form, name in (("parquet", "extras.parquet"), ("csv", "extras.csv")):
        done = dualtaxi(folder, "export", form, run.run_id, "-o", str(tmp_path / form))
        assert done.exit_code == 0, done.output
        assert (tmp_path / form / name).is_file()
    exported = pq.read_table(tmp_path / "parquet/extras.parquet")
    assert exported["extra_logprobs"].to_pylist() == [own["logprobs"].tolist() for own in given]
    rrd = dualtaxi(folder, "export", "rerun", run.run_id, "-o", str(tmp_path / "run.rrd"))
    assert rrd.exit_code == 0, rrd.output


def test_one_environment_alone(tmp_path):
    draws, given = np.random.default_rng(4), []
    with runner.record(talking.Assistant(), tmp_path, make=talking.Assistant) as rec:
        rec.reset(seed=1)
        for t in range(200):
            values = generated(draws, t)
            over = any(rec.step(said(t, 0), extras=values)[2:4])
            if t % 3 == 0:
                values["said"] = "\0" + "thought \N{HORIZONTAL ELLIPSIS} \ud800" * (t % 7)
                values["embedding"] = draws.normal(size=(t % 4, 2)).astype(np.float16)
                rec.note_step(said=values["said"], embedding=values["embedding"])
            given.append(values)
            if over:
                rec.reset()
    outcome = verify(rec.run.recording, trust=True)
    assert outcome.finding == ""
    assert outcome.verdict == "reproduced" or outcome.sound
    with open_recording(rec.run.recording) as recording:
        found = recording.train.extras.at(np.arange(len(given)))
        layouts = [fields["layout"] for fields in recording.table("/extra").decoded()]
    for name, values in found.items():
        assert are_same(values, [own.get(name) for own in given])
    assert layouts == list(range(len(layouts)))
    pd = pytest.importorskip("pandas")
    assert pd is not None


def test_agents_of_a_game(tmp_path):
    given = {"a/tokens": [], "b/tokens": [], "c/tokens": []}
    with runner.record_parallel(Leaving(), tmp_path) as rec:
        for k in range(20):
            rec.reset()
            while rec.agents:
                there = list(rec.agents)
                extras = {agent: {"tokens": np.arange(k % 4 + len(there))} for agent in there}
                rec.step(dict.fromkeys(there, 1), extras=extras)
                for name, values in given.items():
                    values.append(extras.get(name[0], {}).get("tokens"))
    assert verify(rec.run.recording).finding == ""
    with open_recording(rec.run.recording) as recording:
        found = recording.train.extras.at(np.arange(60))
    assert {name: are_same(values, given[name]) for name, values in found.items()} == dict.fromkeys(
        given, True
    )


@pytest.mark.parametrize("is_nested", [True, False])
def test_batches(tmp_path, is_nested):
    draws = np.random.default_rng(0)
    given = []
    with runner.record_batches("mine/Pole", tmp_path, autoreset_mode="NextStep") as rec:
        for batch in range(3):
            length = 4 + batch
            tokens = [[draws.integers(0, 9, draws.integers(0, 5)) for _ in range(2)] for _ in range(length)]
            words = [[f"{batch} {t} {i}" for i in range(2)] for t in range(length)]
            fixed = draws.normal(size=(length, 2, batch + 1))  # another number of numbers in each batch
            extras = {"tokens": tokens, "words": words if is_nested else np.array(words), "fixed": fixed}
            seen = draws.normal(size=(length + 1, 2, 3)).astype(np.float32)
            if given:
                seen[0] = 1
            seen[-1] = 1
            ends = np.zeros((length, 2), bool)
            rec.batch(seen, np.zeros((length, 2), int), np.zeros((length, 2)), ends, extras=extras)
            given += [
                {"tokens": tokens[t][i], "words": words[t][i], "fixed": fixed[t, i]}
                for t in range(length)
                for i in range(2)
            ]
    assert verify(rec.run.recording).finding == ""
    with open_recording(rec.run.recording) as recording:
        found = recording.train.extras.at(np.arange(len(given)))
    for name, values in found.items():
        assert are_same(values, [own[name] for own in given])


def test_a_name_varies_in_length_from_the_step_on_at_which_it_does(tmp_path):
    with runner.record(make("CartPole-v1"), tmp_path) as rec:
        rec.reset(seed=0)
        for k in range(6):
            rec.step(0, extras={"x": np.arange(2 + (k > 3), dtype=np.int16), "y": np.float32(k)})
        rec.note_step(x=np.array([7], np.int16))
        with pytest.raises(
            ConfigError, match=r"found int64 of shape \(\) for 'x', expected int16 of shape \(T,\)"
        ):
            rec.note_step(x=np.int64(1))
        with pytest.raises(ConfigError, match="found int64 of shape"):
            rec.note_step(x=np.arange(3, dtype=np.int64))
    with open_recording(rec.run.recording) as recording:
        blocks = list(recording.train.extras.blocks())
        assert [block["values"]["x"].dtype for block in blocks] == [np.dtype(("<i2", (2,))).base, object]
        found = recording.train.extras.of_episode(0)
    assert [value.tolist() for value in found["x"]] == [[0, 1]] * 4 + [[0, 1, 2], [7]]
    assert {value.dtype for value in found["x"]} == {np.dtype(np.int16)}
    assert verify(rec.run.recording).finding == ""


def test_shards_are_folded_with_all_of_them(tmp_path):
    with runner.record(make("CartPole-v1"), tmp_path) as rec:
        two = runner.record(make("CartPole-v1"), join=rec.run, shard="two")
        for own, sizes in ((rec, (2, 2, 2)), (two, (1, 4, 0))):
            own.reset(seed=0)
            for k in range(9):
                values = {"x": np.arange(sizes[k % 3], dtype=np.int32), "z": np.zeros(1 + (own is two))}
                own.step(k % 2, extras=values | ({"text": f"{k}"} if own is two else {}))
        two.close()
    assert verify(rec.run.recording).finding == ""
    with open_recording(rec.run.recording) as recording:
        found = recording.train.extras.at(np.arange(18))
    assert sorted(len(value) for value in found["x"]) == sorted([2] * 9 + [1, 4, 0] * 3)
    assert found["text"].count() == 9
    assert found["z"].shape == (18, 1)
    assert found["z (two)"].shape == (18, 2)


def test_a_damaged_recording_keeps_what_is_whole(tmp_path):
    with runner.record(make("CartPole-v1"), tmp_path) as rec:
        for k, entry in enumerate(play(rec, 9000)):
            if entry[0] == "step":
                rec.note_step(x=np.arange(k % 5), y=1.0)
    data = bytearray(rec.run.recording.read_bytes())
    with open_recording(rec.run.recording) as recording:
        _, chunks = recording.train.extras.parts[-1]
        entry = chunks.entry(1)
        steps = sum(len(block) for block in recording.train.extras.blocks())
    data[entry.offset + entry.length // 2] ^= 255
    path = tmp_path / "hole.mcap"
    path.write_bytes(data)
    repair(path)
    with open_recording(path) as recording:
        left = np.concatenate([block["step"] for block in recording.train.extras.blocks()])
        assert 0 < len(left) < steps
        some = recording.train.extras.at(left[-3:])["x"]
    assert all(value is not np.ma.masked for value in some)


def test_a_text_with_half_a_character_is_exported_to_rerun_and_refused_by_tables(tmp_path):
    with runner.record(make("CartPole-v1"), tmp_path / "runs", name="half") as rec:
        rec.reset(seed=0)
        rec.step(0, extras={"said": "whole"})
        rec.step(0, extras={"said": "half \ud800"})
    rrd = dualtaxi(tmp_path / "runs", "export", "rerun", "half", "-o", str(tmp_path / "half.rrd"))
    assert rrd.exit_code == 0, rrd.output
    for command in (["archive", "half"], ["export", "csv", "half", "-o", str(tmp_path / "tables")]):
        done = dualtaxi(tmp_path / "runs", *command)
        assert done.exit_code == 2
        assert "message 1 of /train/extra has a text with the unpaired surrogate" in done.output
        assert "repair" not in done.output


def test_a_step_has_at_most_a_megabyte_and_memory_is_bounded(tmp_path):
    with runner.record(make("CartPole-v1"), tmp_path) as rec:
        rec.reset(seed=0)
        for k in range(30):
            if any(rec.step(0, extras={"x": np.full(k * 1000, k), "s": "s" * k})[2:4]):
                rec.reset()
        with pytest.raises(ConfigError, match="bytes a step, expected at most 1,048,576"):
            rec.step(0, extras={"x": np.zeros(100_000, np.int64), "s": "s" * 300_000})
    assert verify(rec.run.recording).finding == ""
    with open_recording(rec.run.recording) as recording:
        found = recording.train.extras.at(np.arange(30))
    assert [len(value) for value in found["x"]] == [1000 * k for k in range(30)]


def test_more_layouts_than_a_recording_holds_are_refused(tmp_path):
    with runner.record(gymnasium.make("CartPole-v1"), tmp_path) as rec:
        rec.reset(seed=0)
        rec.action_space.seed(0)
        names = [(f"a{k}", length) for length in (1, 2) for k in range(140)]
        for name, length in names[:256]:
            if rec.step(rec.action_space.sample(), extras={name: np.zeros(length)})[2]:
                rec.reset()
        name, length = names[256]
        with pytest.raises(ConfigError, match="256 steps with names that were new"):
            rec.step(0, extras={name: np.zeros(length)})
        rec.step(0, extras={"a0": np.zeros(1)})
    check_integrity(rec.run.recording)
    with open_recording(rec.run.recording) as recording:
        assert len(recording.train.extras) == 140
