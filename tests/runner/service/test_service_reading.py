"""The API returns what the recording contains and the commands print."""

from __future__ import annotations

import csv
import dataclasses
import io
import json

import gymnasium
import numpy as np
import pyarrow as pa
import pytest
from click.testing import CliRunner
from pydantic import ValidationError

import runner
from runner.analysis.qtable import one_array
from runner.cli import cli
from runner.recording.reader import open_recording
from runner.replay.tables import tables_at
from runner.runs.resolve import find_run
from runner.service.curves import CurveOptions, curves_of
from runner.service.settings import ServiceLimits
from runner.service.views import _type_of
from runner.views.view import View, view_input

RUN = "/api/v1/runs/first"


def _printed(*words, code=0):
    result = CliRunner().invoke(cli, [*words])
    assert result.exit_code == code, result.output
    return json.loads(result.stdout)


@pytest.fixture
def recording(recordings):
    with open_recording(find_run("first", recordings).recording) as opened:
        yield opened


def test_a_run_is_described_as_by_show(client, recordings):
    shown_here = client.get(RUN).json()
    shown = _printed("show", "first", "--json", "--recordings", str(recordings))
    same = set(shown) - {"eval", "train", "optimality", "checkpoints", "branches", "origin", "path"}
    assert {key: shown_here[key] for key in same} == {key: shown[key] for key in same}
    assert shown_here["last_evaluation"] == shown["eval"][-1]
    assert "path" not in shown_here
    for part, name in (("eval", "evaluations"), ("train", "training"), ("optimality", "optimality")):
        answer = client.get(f"{RUN}/{name}").json()
        assert answer["records"] == shown[part]
        assert answer["total"] == len(shown[part])


def test_a_range_of_records_that_is_too_long_is_refused(connect, settings):
    client = connect(dataclasses.replace(settings, limits=ServiceLimits(page_records=3)))
    assert len(client.get(f"{RUN}/evaluations", params={"start": 1, "stop": 4}).json()["records"]) == 3
    answer = client.get(f"{RUN}/evaluations", params={"stop": 10**9})
    assert answer.status_code == 422
    assert "at most 3" in answer.json()["error"]["message"]


def test_a_view_takes_numbers_between_their_bounds():
    share = view_input("share", "A share.", kind=float, default=0.5, maximum=1)
    bound = view_input("least", "At least this.", kind=float)

    def near(recording, share=share, least=bound):
        """Find what is near."""

    query = _type_of(View("near", "Near", near))
    assert query(share="0.7").model_dump() == {"share": 0.7, "least": None}
    for values in ({"share": "1.5"}, {"share": "nan"}, {"least": "inf"}, {"least": "-1"}):
        with pytest.raises(ValidationError):
            query(**values)


def test_an_episode_that_is_too_long_is_refused_before_it_is_read(connect, settings, monkeypatch):
    client = connect(dataclasses.replace(settings, limits=ServiceLimits(page_records=3)))
    monkeypatch.setattr("runner.service.api.reading.step_columns", None)
    answer = client.get(f"{RUN}/steps/train", params={"episode": 2})
    assert answer.status_code == 422
    assert "at most 3" in answer.json()["error"]["message"]


@pytest.mark.parametrize("phase", ["train", "eval"])
def test_steps_and_episodes_are_those_recorded(client, recording, phase):
    steps = client.get(f"{RUN}/steps/{phase}", params={"start": 10, "stop": 40}).json()
    (block,) = recording.phase(phase).steps.blocks(10, 40)
    assert steps["total"] == recording.phase(phase).steps.count()
    assert steps["columns"]["state"] == block["state"].tolist()
    assert steps["columns"]["reward.agency"] == block["rewards"][:, 0].tolist()
    one = client.get(f"{RUN}/steps/{phase}", params={"episode": 2}).json()
    assert one["columns"]["t"] == list(range(len(recording.phase(phase).episode_steps(2))))
    episodes = client.get(f"{RUN}/episodes/{phase}", params={"start": 1, "stop": 3}).json()
    assert episodes["columns"]["length"] == recording.phase(phase).episodes.array(1, 3)["length"].tolist()


def test_arrow_has_the_same_columns(client):
    for table in ("steps", "episodes"):
        params = {"start": 5, "stop": 30}
        listed = client.get(f"{RUN}/{table}/train", params=params).json()["columns"]
        body = client.get(f"{RUN}/{table}/train.arrow", params=params).content
        assert pa.ipc.open_stream(body).read_all().to_pydict() == listed


def test_the_q_table_at_a_step_is_the_exact_one(client, recording, recordings):
    body = client.get(f"{RUN}/qtable.npy", params={"step": 777}).content
    np.testing.assert_array_equal(
        np.load(io.BytesIO(body), allow_pickle=False), one_array(tables_at(recording, 777))
    )
    params = {"step": 777, "state": 17}
    shown_here = client.get(f"{RUN}/qtable", params=params).json()
    words = ("--step", "777", "--state", "17", "--json", "--recordings", str(recordings))
    assert shown_here == _printed("qtable", "first", *words)


def test_a_moment_that_does_not_exist_is_refused(client):
    assert client.get(f"{RUN}/qtable", params={"step": 10**9}).status_code == 404
    assert client.get(f"{RUN}/qtable", params={"step": 1, "episode": 1}).status_code == 422
    assert client.get(f"{RUN}/qtable", params={"step": 1, "state": 10**6}).status_code == 422
    assert client.get(f"{RUN}/steps/train", params={"episode": 10**6}).status_code == 404
    assert client.get(f"{RUN}/steps/test").status_code == 422


def test_a_range_after_the_end_is_empty_and_a_too_long_one_refused(client):
    answer = client.get(f"{RUN}/steps/train", params={"start": 10**9, "stop": 10**9 + 5})
    assert answer.status_code == 200
    assert answer.json()["columns"]["step"] == []
    long = client.get(f"{RUN}/steps/train.arrow", params={"start": 0, "stop": 10**9})
    assert long.status_code == 422
    assert "in parts" in long.json()["error"]["message"]


def test_metrics_are_complete_or_marked_as_thinned(client, recording):
    curves = client.get(f"{RUN}/metrics").json()["curves"]
    finish = next(curve for curve in curves if curve["metric"] == "success_percent")
    recorded = [record["success_percent"] for record in recording.eval.all_metrics()]
    assert finish["values"] == recorded
    assert not finish["thinned"]
    params = {"points": 2, "metric": "success_percent"}
    (thin,) = client.get(f"{RUN}/metrics", params=params).json()["curves"]
    assert thin["thinned"]
    assert thin["of"] == len(recorded)
    assert {min(recorded), max(recorded)} <= set(thin["values"])
    (part,) = client.get(
        f"{RUN}/metrics", params=params | {"points": 0, "start": finish["positions"][1]}
    ).json()["curves"]
    assert part["values"] == recorded[1:]


def test_metrics_are_read_over_any_axis_that_the_run_has(client, recording):
    over_steps = client.get(f"{RUN}/metrics", params={"axis": "steps", "metric": "success_percent"}).json()
    assert [axis["name"] for axis in over_steps["axes"]] == ["episodes", "steps", "updates", "time"]
    (curve,) = over_steps["curves"]
    assert curve["positions"] == [record["step"] for record in recording.eval.all_metrics()]
    refused = client.get(f"{RUN}/metrics", params={"axis": "stops"})
    assert refused.status_code == 400
    assert "Did you mean 'steps'" in refused.json()["error"]["message"]


def test_runs_that_differ_in_the_seed_are_one_curve_with_a_band(recordings, client):
    config = {"env": {"id": "FrozenLake-v1"}, "episodes": 40, "evaluation": {"every": 20, "trials": 5}}
    runs = list(runner.run_all(config | {"name": "seeds", "seeds": [0, 1, 2, 3, 4]}, recordings=recordings))
    params = {"run": [run.run_id for run in runs], "metric": "mean_length", "lines": True}
    found = client.get("/api/v1/curves", params=params).json()
    assert found["groups"] == [{"label": "seeds", "runs": params["run"], "left_out": []}]
    (curve,) = found["curves"]
    for k, values in enumerate(zip(*curve["runs"], strict=True)):
        assert curve["values"][k] == pytest.approx(np.mean(sorted(values)[1:-1]))
        assert min(values) <= curve["low"][k] <= curve["values"][k] <= curve["high"][k] <= max(values)
    assert curve["label"] == "A, B, C, D, E: seeds"
    head, *rows = csv.reader(client.get("/api/v1/curves.csv", params=params).text.splitlines())
    label, runs = curve["label"], [f"{letter}: seeds" for letter in "ABCDE"]
    assert head == ["episodes", f"{label}, high", f"{label}, low", *runs, label]
    assert [float(row[-1]) for row in rows] == curve["values"]
    alone = client.get("/api/v1/curves", params={"run": params["run"][:1], "metric": "mean_length"}).json()
    assert (alone["curves"][0]["low"], alone["curves"][0]["runs"]) == (None, [])


def test_a_run_of_a_group_that_lacks_a_metric_has_no_line(tmp_path):
    runs = []
    for seed, name in enumerate(("loss", "acc", "acc")):
        with runner.record(gymnasium.make("CartPole-v1"), tmp_path, name="same", seed=seed) as env:
            env.reset(seed=seed)
            env.step(0)
            env.log(name, 0.5)
        runs.append(env.run)
    options = CurveOptions(metric=("training.logged.acc",))
    paths = [run.recording for run in runs]
    found = json.loads(curves_of(paths, options, lines=True))
    (curve,) = found["curves"]
    assert curve["run_labels"] == ["B: same", "C: same"]
    assert "Every recorded point is drawn." not in found["notes"], "at points that the runs share"
    head, *rows = csv.reader(curves_of(paths, options, lines=True, table=True).decode().splitlines())
    assert head[3:5] == curve["run_labels"]
    assert all(len(row) == len(head) for row in rows)
    both = csv.reader(curves_of(paths, CurveOptions(), lines=True, table=True).decode().splitlines())
    assert len(set(head := next(both))) == len(head)


def test_histograms_count_every_step(client, recording):
    found = client.get(f"{RUN}/histograms", params={"axis": "steps"}).json()
    rewards = [each for each in found["histograms"] if each["quantity"] == "reward"]
    steps = recording.train.steps.count()
    assert [sum(map(sum, each["counts"])) for each in rewards] == [steps] * len(rewards)
    assert client.get(f"{RUN}/histograms", params={"axis": "none"}).status_code == 400


def test_runs_are_compared_over_environments(recordings, client):
    runs = []
    for name, discount in (("near", 0.5), ("far", 0.9)):
        for env_id in ("FrozenLake-v1", "FrozenLake8x8-v1"):
            config = {"name": name, "discount": discount, "env": {"id": env_id}, "seeds": [0, 1]}
            config |= {"episodes": 20, "evaluation": {"every": 10, "trials": 5}}
            runs += runner.run_all(config, recordings=recordings)
    ids = [run.run_id for run in runs]
    table = "task,random,expert\nFrozenLake-v1,-1,1\nFrozenLake8x8-v1,-1,1\n"
    params = {"run": ids, "normalise": table, "metric": "mean_return"}
    found = client.get("/api/v1/compare", params=params).json()
    assert set(found["tasks"]) == {"FrozenLake-v1", "FrozenLake8x8-v1"}
    assert [sum(own["seeds"].values()) for own in found["algorithms"]] == [4, 4]
    unread = client.get("/api/v1/compare", params=params | {"normalise": str(runs[0].recording)})
    assert unread.status_code == 400  # a text, never the path of a file
    assert "expected task, random, expert" in unread.json()["error"]["message"]
    part = client.get("/compare/tasks", params={"run": ids, "scores": table})
    assert part.text.count("<svg") == 3
    asked = {"params": {"run": ids}, "headers": {"accept": "text/html"}, "follow_redirects": False}
    address = client.get("/compare/tasks", **asked).headers["location"]
    assert address == f"/compare?run={'&run='.join(ids)}#environments", "opened alone, it is no page"
    apart = client.get("/compare/tasks", params={"run": [ids[1], ids[6]]}).text
    assert apart.startswith('<p class="hint">Found no environment in which every group has a value (')
    assert 'data-later="/compare/tasks?' in client.get("/compare", params={"run": ids}).text
    assert "data-later" not in client.get("/compare", params={"run": ids[:2]}).text
    refused = client.get(
        "/compare/tasks",
        params={"run": ids, "scores": "task,random\n"},
        headers={"accept": "application/json"},
    )
    assert refused.status_code == 400
    assert "expected task, random, expert" in refused.json()["error"]["message"]


def test_plots_are_pictures(client):
    assert client.get(f"{RUN}/plot.svg").content.startswith(b"<?xml")
    assert client.get(f"{RUN}/plot.png").status_code == 404


def test_diff_and_compare_equal_the_commands(client, recordings):
    place = ("--json", "--recordings", str(recordings))
    diff = client.get("/api/v1/diff", params={"a": "first", "b": "second", "target": "success_percent=1"})
    assert diff.json() == _printed("diff", "first", "second", "--target", "success_percent=1", *place, code=1)
    params = {"run": ["first", "second"], "by": "name"}
    compared = client.get("/api/v1/compare", params=params).json()
    assert compared == _printed("compare", "first", "second", "--by", "name", *place)
    alone = client.get("/api/v1/compare", params={"run": "first"})
    assert alone.status_code == 400
    assert "expected at least two" in alone.json()["error"]["message"]
    for path, runs in (("diff", {"a": "first", "b": "second"}), ("compare", {"run": ["first", "second"]})):
        wrong = client.get(f"/api/v1/{path}", params={**runs, "target": "foo"})
        assert wrong.status_code == 422
        assert "query.target" in wrong.json()["error"]["message"]
        assert "found 'foo', expected METRIC=LEVEL" in wrong.json()["error"]["message"]


def test_the_recording_is_served_whole_and_in_ranges(client, recordings):
    run = find_run("first", recordings)
    whole = run.recording.read_bytes()
    answer = client.get(f"{RUN}/recording")
    assert answer.content == whole
    assert run.summary["content_digest"] in answer.headers["etag"]
    part = client.get(f"{RUN}/recording", headers={"Range": "bytes=100-299"})
    assert (part.status_code, part.content) == (206, whole[100:300])
    assert part.headers["content-range"] == f"bytes 100-299/{len(whole)}"
    again = client.get(f"{RUN}/recording", headers={"If-None-Match": answer.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    stale = client.get(f"{RUN}/recording", headers={"Range": "bytes=100-299", "If-Range": '"other"'})
    assert (stale.status_code, len(stale.content)) == (200, len(whole))
    head = client.head(f"{RUN}/recording")
    assert int(head.headers["content-length"]) == len(whole)


def test_the_replay_is_made_once_and_cached(client, recordings):
    first = client.get(f"{RUN}/replay.rrd", params={"episodes": "0:2"})
    assert first.content.startswith(b"RRF2")
    again = client.get(f"{RUN}/replay.rrd", params={"episodes": "0:2"})
    assert again.content == first.content
    assert client.get(f"{RUN}/replay.rrd", params={"episodes": "x"}).status_code == 422
    for trial in (10**12, 10**30, -1):
        missing = client.get(f"{RUN}/replay.rrd", params={"trials": trial})
        assert missing.status_code == 404
        assert "there are 140, from 0" in missing.json()["error"]["message"]


def test_a_damaged_recording_is_reported(client, recordings):
    run = find_run("first", recordings)
    run.recording.write_bytes(run.recording.read_bytes()[:1000])
    assert client.get(f"{RUN}/metrics").status_code == 409
    shown_here = client.get(RUN).json()
    assert shown_here["problems"]
    assert shown_here["status"] == "finished"
    run.recording.unlink()
    assert client.get(f"{RUN}/steps/train").status_code == 409
    assert client.get(f"{RUN}/recording").status_code == 409


def test_composed_values_of_a_loop_are_separate_columns(client, recordings):
    space = gymnasium.spaces.Dict(
        {"place": gymnasium.spaces.Box(-1, 1, (2,)), "go": gymnasium.spaces.Discrete(3)}
    )

    class Walk(gymnasium.Env):
        observation_space, action_space = space, gymnasium.spaces.Discrete(2)

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return space.sample(), {}

        def step(self, action):
            return space.sample(), 1.0, False, True, {}

    with runner.record(Walk(), name="walk", recordings=recordings) as env:
        for _ in range(4):
            env.reset(seed=1)
            env.step(0)
    shown_here = client.get("/api/v1/runs/walk/steps/train").json()["columns"]
    assert np.shape(shown_here["next_observation.place"]) == (4, 2)
    body = client.get("/api/v1/runs/walk/steps/train.arrow").content
    assert pa.ipc.open_stream(body).read_all().to_pydict() == shown_here
    assert client.get("/api/v1/runs/walk/qtable").status_code == 400


def test_a_picture_of_curves_has_the_metrics_that_are_asked_for(client):
    whole, one = (
        client.get(f"/api/v1/curves.svg?run=first&run=second{more}").text
        for more in ("", "&metric=mean_length")
    )
    assert len(one) < len(whole) / 3
    refused = client.get("/api/v1/curves.svg?run=first&metric=nosuch")
    assert (refused.status_code, "found nosuch" in refused.text) == (400, True)
