"""Checkpoints of loops: kept once, loaded as they were, and carried along wherever the run goes."""

from __future__ import annotations

import json
import os
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
from blake3 import blake3

import runner
from runner.errors import ConfigError, RecordingError, RunnerError
from runner.execution.verify import verify
from runner.runs.checkpoints import Store, arrays_in
from runner.runs.resolve import find_run
from tests.runner.loops.making import dualtaxi, make, play
from tests.runner.loops.test_loops_extras import Tensor

safetensors = pytest.importorskip("safetensors.numpy")


def weights(step):
    return {
        "layer.weight": Tensor(np.full((2, 3), step, np.float32)),
        "head": {"bias": np.arange(4, dtype=np.int64), "scale": np.float64(step)},
    }


def record_loop(folder, name, **options):
    """Record a loop with checkpoints after 1, 41, 81 steps, of which the first two are equal."""
    with runner.record(make("CartPole-v1"), folder, name=name, **options) as rec:
        steps = 0
        for entry in play(rec, 100):
            if entry[0] == "step":
                steps += 1
                if steps % 40 == 1:
                    rec.checkpoint("policy", weights(steps > 60))
        rec.checkpoint("notes", f"made by {name}".encode())
    return rec.run


def objects(folder):
    return sorted(path.name for path in Path(folder, ".store/objects").glob("*/*"))


def test_checkpoints_are_listed_with_their_step_and_loaded_as_they_were(tmp_path):
    run = record_loop(tmp_path, "one")
    found = [(each.name, each.phase, each.step, each.format) for each in run.checkpoints()]
    expected = [("policy", "train", step, "safetensors") for step in (1, 41, 81)]
    assert found == [*expected, ("notes", "train", 100, "bytes")]
    assert len(objects(tmp_path)) == 3, "equal contents are kept once"
    loaded = run.checkpoints()[2].load()
    assert {name: (values.dtype.str, values.tolist()) for name, values in loaded.items()} == {
        "layer.weight": ("<f4", [[1, 1, 1], [1, 1, 1]]),
        "head/bias": ("<i8", [0, 1, 2, 3]),
        "head/scale": ("<f8", 1),
    }
    assert run.checkpoints()[3].load() == b"made by one"
    np.testing.assert_array_equal(
        safetensors.load_file(run.checkpoints()[0].path)["layer.weight"], np.zeros((2, 3), np.float32)
    )
    assert verify(run.recording).finding == ""


def test_files_and_pickles_are_kept_as_they_are_and_a_pickle_is_loaded_only_if_trusted(tmp_path):
    Path(tmp_path, "model.pt").write_bytes(b"any format")
    with runner.record(make("CartPole-v1"), tmp_path / "runs") as rec:
        rec.checkpoint("model", tmp_path / "model.pt")
        rec.checkpoint("object", {"a", "b"}, pickle=True)
        with pytest.raises(ConfigError, match="pickle=True records any other object"):
            rec.checkpoint("object", {"a", "b"})
    model, found = rec.run.checkpoints()
    assert (model.format, model.load()) == ("file", b"any format")
    with pytest.raises(RunnerError, match="can run any program"):
        found.load()
    assert found.load(trust=True) == {"a", "b"}
    assert pickle.loads(found.path.read_bytes()) == {"a", "b"}


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("", b"", "expected printable text"),
        ("a@b", b"", "without @"),
        ("x" * 201, b"", "expected printable text"),
        (5, b"", "expected printable text"),
        ("policy", "missing.pt", "expected that of a file"),
        ("policy", {}, "at least one"),
        ("policy", {"a": "text"}, "expected an array of numbers"),
        ("policy", {"a": object()}, "expected an array of numbers"),
        ("policy", 5, "expected bytes, a path, or a mapping"),
    ],
)
def test_what_is_no_checkpoint_is_refused(tmp_path, name, value, message):
    with runner.record(make("CartPole-v1"), tmp_path) as rec, pytest.raises(ConfigError, match=message):
        rec.checkpoint(name, value)
    assert rec.run.checkpoints() == []


def test_commands_list_and_get_checkpoints(tmp_path):
    record_loop(tmp_path, "one")
    listed = json.loads(dualtaxi(tmp_path, "checkpoints", "one", "--json").stdout)["checkpoints"]
    assert [(each["name"], each["step"], each["here"]) for each in listed] == [
        *(("policy", step, True) for step in (1, 41, 81)),
        ("notes", 100, True),
    ]
    assert "policy@81" in dualtaxi(tmp_path, "checkpoints", "one").output
    assert "4, the last notes@100" in dualtaxi(tmp_path, "show", "one").output
    assert json.loads(dualtaxi(tmp_path, "show", "one", "--json").stdout)["checkpoints"] == listed
    for reference, step in (
        ("@50", 41),
        ("policy@latest", 81),
        ("policy", 81),
        ("notes@1000", 100),
        ("@latest", 100),
    ):
        path = tmp_path / f"{step}.bin"
        done = dualtaxi(tmp_path, "checkpoint", "get", "one", reference, "-o", str(path), "--force")
        assert done.exit_code == 0, done.output
        assert blake3(path.read_bytes()).hexdigest() == next(
            each["digest"] for each in listed if each["step"] == step
        )
    for reference in ("@0", "other@5", "@x"):
        done = dualtaxi(tmp_path, "checkpoint", "get", "one", reference, "-o", str(tmp_path / "no"))
        assert done.exit_code == 2
        assert "checkpoint" in done.output
    assert "expected" in dualtaxi(tmp_path, "checkpoint", "get", "one", "@x").output
    with runner.record(make("CartPole-v1"), tmp_path, name="none") as rec:
        rec.reset(seed=0)
    lacking = dualtaxi(tmp_path, "checkpoint", "get", "none", "@0")
    assert "has no checkpoints; a loop records one by rec.checkpoint" in lacking.output


def test_a_changed_content_is_found_and_a_missing_one_is_noted(tmp_path):
    run = record_loop(tmp_path, "one")
    first, *_, last = run.checkpoints()
    last.path.unlink()
    checked = verify(run.recording)
    assert checked.finding == ""
    assert any("1 checkpoints are not here, the first notes@100" in note for note in checked.notes)
    with pytest.raises(RecordingError, match="not here"):
        last.load()
    first.path.write_bytes(first.path.read_bytes()[:-1] + b"x")
    assert "policy@1" in verify(run.recording).finding
    with pytest.raises(RecordingError, match="was changed"):
        first.load()


def test_removing_runs_removes_contents_that_no_other_run_refers_to(tmp_path):
    record_loop(tmp_path, "one")
    second = record_loop(tmp_path, "two")
    before = objects(tmp_path)
    assert len(before) == 4
    dry = json.loads(dualtaxi(tmp_path, "rm", "one", "--dry-run", "--json").stdout)
    assert dry["checkpoints"] == len("made by one")
    assert "no other run refers to" in dualtaxi(tmp_path, "rm", "one", "--dry-run").output
    assert objects(tmp_path) == before
    used = json.loads(dualtaxi(tmp_path, "du", "--json").stdout)
    assert used["total"]["checkpoints"] == sum(Store(tmp_path).sizes().values()) > 0
    assert dualtaxi(tmp_path, "rm", "one", "--yes").exit_code == 0
    assert objects(tmp_path) == sorted({each.digest for each in second.checkpoints()})
    assert not any("not here" in note for note in verify(second.recording).notes)
    shutil.rmtree(second.folder)
    third = record_loop(tmp_path, "three")
    left_over = tmp_path / ".store/objects/.0123456789abcdef"
    left_over.write_bytes(b"by a process that was killed")
    for path in (left_over, tmp_path / ".store/runs" / second.folder.name):
        os.utime(path, (0, 0))
    assert dualtaxi(tmp_path, "prune", 'name == "three"', "--yes").exit_code == 0
    assert not left_over.exists()
    assert not third.folder.exists()
    assert objects(tmp_path) == []


def test_an_archive_has_the_contents_and_a_restore_brings_them_back(tmp_path):
    folder, archive = tmp_path / "runs", tmp_path / "archive"
    run = record_loop(folder, "one")
    before = objects(folder)
    done = dualtaxi(folder, "archive", "one", "--to", str(archive), "--remove")
    assert done.exit_code == 0, done.output
    assert objects(folder) == []
    listed = json.loads(dualtaxi(folder, "checkpoints", "one", "--json").stdout)["checkpoints"]
    assert [each["here"] for each in listed] == [False] * 4
    assert dualtaxi(folder, "restore", "one").exit_code == 0
    assert objects(folder) == before
    assert verify(run.recording).content_digest == run.summary.content_digest
    other = tmp_path / "other"
    done = dualtaxi(other, "restore", str(archive / run.run_id))
    assert done.exit_code == 0, done.output
    assert find_run("one", other).checkpoints()[3].load() == b"made by one"


def test_an_imported_recording_keeps_the_contents_that_it_refers_to(tmp_path):
    folder = tmp_path / "runs"
    run = record_loop(folder, "one")
    before = objects(folder)
    assert dualtaxi(folder, "export", "mcap", "one", "-o", str(tmp_path / "one.mcap")).exit_code == 0
    done = dualtaxi(folder, "import", str(tmp_path / "one.mcap"), "--as-new")
    assert done.exit_code == 0, done.output
    assert dualtaxi(folder, "rm", run.run_id, "--yes").exit_code == 0
    assert objects(folder) == before
    (left,) = runner.list_runs(folder)
    assert left.checkpoints()[3].load() == b"made by one"


def test_a_digest_that_is_a_path_leads_nowhere(tmp_path):
    store = Store(tmp_path)
    for digest in ("../../secret", "/etc/passwd", "a" * 63, "A" * 64, "a" * 64 + "\n"):
        with pytest.raises(RecordingError, match="expected 64 hexadecimal digits"):
            store.path(digest)
    with pytest.raises(RecordingError, match="it was changed"):
        store.put("run", b"content", expected="0" * 64)
    assert objects(tmp_path) == []
    assert [path for path in tmp_path.rglob("*") if path.name.startswith(".") and path.is_file()] == []


def test_a_name_that_no_recorder_writes_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("runner.loops.messages.is_checkpoint_name", lambda _: True)
    with runner.record(make("CartPole-v1"), tmp_path) as rec:
        rec.checkpoint("\x1b[2J", b"content")
    with pytest.raises(RecordingError, match="invalid checkpoint"):
        rec.run.checkpoints()


def test_a_store_that_was_damaged_is_mended_by_the_same_content(tmp_path):
    store = Store(tmp_path)
    digest, size = store.put("run", b"content")
    store.path(digest).write_bytes(b"CONTENT")
    references = tmp_path / ".store/runs/run"
    references.write_bytes(references.read_bytes()[:-20])  # cut off when the machine failed
    for _ in range(2):
        assert store.put("run", b"content") == (digest, size)
        assert store.path(digest).read_bytes() == b"content"
        assert store.of_run("run") == [digest]


def test_a_file_that_is_no_safetensors_is_refused():
    for data in (b"", b"\xff" * 8, b"\0" * 100, os.urandom(64)):
        with pytest.raises(RecordingError, match="found no safetensors file"):
            arrays_in(data, "here")


def test_bfloat16_is_widened_exactly():
    header = json.dumps({"x": {"dtype": "BF16", "shape": [2], "data_offsets": [0, 4]}}).encode()
    data = len(header).to_bytes(8, "little") + header + np.array([0x3F80, 0xC000], "<u2").tobytes()
    assert arrays_in(data, "here")["x"].tolist() == [1.0, -2.0]
