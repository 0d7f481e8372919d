"""Impossible values in `run.json` and in results: listed, shown and removable, never trusted."""

from __future__ import annotations

import json
import shutil

import pytest
from click.testing import CliRunner
from mcap.reader import make_reader

from runner.cli import cli
from runner.errors import RecordingError
from runner.execution.verify import verify
from runner.recording.integrity import survey
from runner.recording.reader import open_recording
from runner.recording.schema import LOG_TOPIC
from runner.runs.importing import import_recording
from runner.runs.run import RUN_FILE, list_runs
from tests.reliability.reading import TINY
from tests.runner.altering import altered
from tests.runner.recording.making import make_run


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Return a recordings folder with two runs as small as can be."""
    folder = tmp_path_factory.mktemp("recorded")
    for name in ("first", "second"):
        make_run(folder, TINY, name=name)
    return folder


def nested(depth):
    return json.loads("[" * depth + "]" * depth)


WRONG = [
    *(None, True, -1, 2**64, 10**400, 1.5, 1e308, float("nan"), float("inf"), "", "x", "\ud800", "../../x"),
    *("a\nb", [], [1], {}, {"a": {"b": []}}, nested(300)),
]
KEYS = (
    "name",
    "seed",
    "status",
    "created",
    "owner",
    "config",
    "summary",
    "archive",
    "provenance",
    "recording",
)
SUMMARY = ("train_steps", "eval_steps", "episodes", "seconds", "bytes", "content_digest", "topic_digests")
SUMMARY += ("messages", "last_evaluation", "error", "steps_recorded", "recent_training", "logged")
CONFIG = ("name", "episodes", "env", "evaluation", "tables", "rewards", "seeds")
EVALUATION = ("success_percent", "mean_length", "mean_penalties", "episode")


def mutations(facts):
    """Yield facts of which one value is another, or missing."""
    places = [((), KEYS), (("summary",), SUMMARY), (("config",), CONFIG)]
    places.append((("summary", "last_evaluation"), EVALUATION))
    for path, keys in places:
        for k, key in enumerate(keys):
            for wrong in (*WRONG[k % 3 :: 3], KEYS):
                changed = json.loads(json.dumps(facts))
                part = changed
                for name in path:
                    part = part[name]
                if wrong is KEYS:
                    part.pop(key, None)
                else:
                    part[key] = wrong
                yield f"{'.'.join((*path, key))}={str(wrong)[:20]!r}" if wrong != 10**400 else key, changed


def shown(recordings, *words):
    """Return the output of a command, which must not end in a traceback."""
    result = CliRunner().invoke(cli, list(map(str, words)), env={"DUALTAXI_RECORDINGS": str(recordings)})
    expected = result.exception is None or isinstance(result.exception, SystemExit)
    assert expected, (words, result.exception)
    return result


def test_no_value_in_a_run_file_breaks_a_command_or_a_page(recordings, client):
    first, second = reversed(list_runs(recordings))
    pages = [f"/runs/{first.run_id}{tab}" for tab in ("", "/config", "/evaluations")]
    pages += [f"/api/v1/runs/{first.run_id}", f"/compare?run={first.run_id}&run={second.run_id}", None]
    for k, (what, facts) in enumerate(
        mutations(first.facts)
    ):  # each key has seven, each view sees two of them
        (first.folder / RUN_FILE).write_text(json.dumps(facts))
        for page in (pages[k % 6], pages[(k + 3) % 6]):
            if page is None:
                assert shown(recordings, "show", first.run_id).exit_code == 0, what
            else:
                assert client.get(page).status_code < 500, (what, page)


def test_no_value_in_a_run_file_hides_the_run_or_prevents_its_removal(recordings, tmp_path):
    first, _ = reversed(list_runs(recordings))
    whole = json.loads(json.dumps(first.facts))
    many = tmp_path / "many"
    ids = []
    for k, (_, facts) in enumerate(mutations(whole)):
        run_id = f"run{k}"
        (many / run_id).mkdir(parents=True)
        (many / run_id / RUN_FILE).write_text(json.dumps(facts | {"run_id": run_id}))
        ids.append(run_id)
    listed = shown(many, "ls", "--json")
    assert sorted(run["run_id"] for run in json.loads(listed.stdout)["runs"]) == sorted(ids)
    assert shown(many, "ls").exit_code == 0
    assert shown(many, "prune", "--keep-last", "0", "--dry-run").exit_code == 0
    damaged = shown(many, "ls", "--quiet", 'status == "damaged"').stdout.split()
    assert len(damaged) > len(ids) / 3
    assert shown(many, "rm", "--yes", damaged[0]).exit_code == 0
    assert shown(many, "prune", "--status", "damaged", "--yes").exit_code == 0
    assert shown(many, "ls", "--quiet", 'status == "damaged"').stdout == ""


def test_a_log_that_cannot_be_read_is_not_called_empty(recordings, client):
    first, _ = reversed(list_runs(recordings))
    *_, chunk = (part for part in survey(first.recording).chunks if part.channel == LOG_TOPIC.channel)
    data = bytearray(first.recording.read_bytes())
    data[chunk.offset + 60] ^= 1
    first.recording.write_bytes(data)
    page = client.get(f"/runs/{first.run_id}/config").text
    assert f"The log cannot be read: {first.run_id}/recording.mcap: " in page
    assert "logged no texts" not in page


def test_a_damaged_run_has_a_message(recordings, client):
    first, _ = reversed(list_runs(recordings))
    facts = json.loads(json.dumps(first.facts))
    facts["summary"]["train_steps"] = "many"
    (first.folder / RUN_FILE).write_text(json.dumps(facts))
    what = "summary.train_steps: found 'many', expected a whole number from 0 up"
    flat = " ".join(shown(recordings, "show", first.run_id).stdout.split())
    assert what in flat
    assert "damaged" in flat
    assert what in client.get(f"/runs/{first.run_id}").text.replace("&#39;", "'")
    assert what in shown(recordings, "ls").stderr
    (row,) = (
        run for run in json.loads(shown(recordings, "ls", "--json").stdout)["runs"] if run["name"] == "first"
    )
    assert (row["status"], row["train_steps"]) == ("damaged", None)


def test_the_replay_of_a_damaged_recording_has_the_status_of_damage(recordings, client):
    first, _ = reversed(list_runs(recordings))
    with first.recording.open("r+b") as file:
        summary = make_reader(file).get_summary()
        (steps,) = (each.id for each in summary.channels.values() if each.topic == "/train/step")
        for chunk in (each for each in summary.chunk_indexes if steps in each.message_index_offsets):
            file.seek(chunk.chunk_start_offset + chunk.chunk_length // 2)
            file.write(b"\0\xff\0\xff")
    page = client.get("/runs/first/replay/train/0")
    assert page.status_code == client.get("/api/v1/runs/first/replay/train/0").status_code == 409
    assert 'role="alert"' in page.text
    assert client.get("/runs/second/replay/train/999").status_code == 404


@pytest.mark.parametrize(
    ("key", "wrong"),
    [
        *(("train_steps", wrong) for wrong in ("x", {}, -1, None, 1.5)),
        *(("last_evaluation", wrong) for wrong in ([], "x", {"mean_length": float("nan")})),
        *(("episodes", None), ("status", "odd"), ("status", "running"), ("messages", {"/log": "x"})),
        ("more", nested(200)),
    ],
)
def test_an_impossible_result_is_refused(recordings, tmp_path, key, wrong):
    first, _ = reversed(list_runs(recordings))

    def change(entries):
        return {"json": json.dumps(json.loads(entries["json"]) | {key: wrong})}

    made = altered(first.recording, tmp_path / "made.mcap", None, id, result=change)
    finding = verify(made).finding
    assert "result" in finding
    with open_recording(made) as recording, pytest.raises(RecordingError, match="result"):
        _ = recording.result
    with pytest.raises(RecordingError):
        import_recording(made, tmp_path / "theirs")
    assert not (tmp_path / "theirs").exists() or not list((tmp_path / "theirs").iterdir())
    if key == "more":  # of JSON that cannot be parsed nothing is known
        assert shown(recordings, "show", made).exit_code == 2
        return
    assert shown(recordings, "show", made).exit_code == 0
    shutil.copy(made, first.recording)
    (first.folder / RUN_FILE).unlink()
    (row,) = (
        run for run in json.loads(shown(recordings, "ls", "--json").stdout)["runs"] if run["name"] == "first"
    )
    assert row["status"] == ("interrupted" if wrong == "running" else "damaged")
    assert shown(recordings, "show", first.run_id).exit_code == 0
    assert shown(recordings, "rm", "--yes", first.run_id).exit_code == 0
