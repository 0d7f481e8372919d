"""Episodes of loops in pages: their values, and what cannot be shown, with the reason."""

from __future__ import annotations

import html
import os
import re
import shutil
import sys

import gymnasium
import numpy as np
import pytest
from loop_replays import page, part, pictures, serving, steps_of, taken

import runner
from runner.recording import schema
from runner.recording.environment import NAMES
from runner.recording.reader import open_recording
from runner.runs.resolve import find_run
from runner.runs.run import Run


@pytest.mark.parametrize(
    ("address", "phase", "episode"),
    [("train/0", "train", 0), ("train/3", "train", 3), ("eval/4/2", "eval", 2)],
)
def test_a_part_has_the_recorded_values_from_the_reset_on(loops_client, loops, address, phase, episode):
    steps = steps_of(loops, "pole", phase, episode)
    whole = part(loops_client, f"pole/replay/{address}")
    assert whole["length"] == len(steps) == len(whole["reward"])
    assert taken(whole["actions"][0]) == [("left", "right")[action] for action in steps["action"]]
    with open_recording(find_run("pole", loops).recording) as recording:
        first = [reset["observation"].copy() for reset in recording.phase(phase).reset_values()][episode]
    for k, series in enumerate(whole["series"]):
        assert series["name"] == NAMES["CartPoleEnv"][k]
        expected = np.append(first[k], steps["next_observation"][:, k])
        assert series["values"] == pytest.approx(expected, rel=1e-4)
    later = part(loops_client, f"pole/replay/{address}", start=5, steps=4)
    assert later["first"] == 4
    assert later["before"] == [4]
    assert later["series"][0]["values"] == whole["series"][0]["values"][4:9]


@pytest.mark.parametrize("name", ["pole", "rooms"])
def test_the_episodes_of_a_recording_that_was_cut_off_are_those_of_its_steps(
    loops_client, loops, tmp_path, name
):
    whole = find_run(name, loops)
    run = Run(tmp_path / "runs" / "cut", whole.facts)
    shutil.copytree(whole.folder, run.folder)
    with open_recording(run.recording) as recording:
        end = recording.train.episodes.entry(0).offset
    os.truncate(run.recording, end)
    with open_recording(run.recording) as recording:
        assert not recording.train.episodes.count()
    with serving(tmp_path / "runs") as client:
        for episode in range(4):
            steps = steps_of(loops, name, "train", episode)
            shown = part(client, f"{run.run_id}/replay/train/{episode}")
            assert shown["length"] == len(steps)
            assert shown["description"] == part(loops_client, f"{name}/replay/train/{episode}")["description"]
        assert 'placeholder="0 to 3"' in page(client, f"/runs/{run.run_id}/replay/train/0")


def test_what_was_logged_near_a_step_is_there_with_its_place(loops_client, loops):
    shown = part(loops_client, "pole/replay/train/1")
    (loss,) = shown["logged"]
    lengths = [len(steps_of(loops, "pole", "train", episode)) for episode in range(4)]
    assert loss["name"] == "loss"
    assert loss["at"] == np.cumsum(lengths).tolist()
    assert loss["values"] == pytest.approx([1, 1 / 2, 1 / 3, 1 / 4], rel=1e-4)
    assert shown["time"][0] == lengths[0]


def test_the_episode_of_a_vector_is_that_of_its_environment(loops_client, loops):
    steps = steps_of(loops, "poles", "train", 4)
    shown = part(loops_client, "poles/replay/train/4")
    assert f"in environment {steps['step'][0] % 3}" in shown["title"]
    assert shown["series"][2]["values"][1:] == pytest.approx(steps["next_observation"][:, 2], rel=1e-4)
    found, problem = pictures(loops_client, "poles/replay/train/4", steps=1000)
    assert (len(found), problem) == (len(steps) + 1, "")


def test_the_environments_of_a_vector_are_shown_side_by_side_from_the_same_step(loops_client, loops):
    own = steps_of(loops, "poles", "train", 4)
    text = page(loops_client, "/runs/poles/replay/train/4/environments?t=2")
    panels = re.findall(
        r'data-source="/api/v1/runs/\w+/replay/train/(\d+)" data-offset="(-?\d+)".*?Environment (\d)',
        text,
        re.DOTALL,
    )
    assert [environment for *_, environment in panels] == ["0", "1", "2"]
    for episode, offset, environment in panels:
        steps = steps_of(loops, "poles", "train", int(episode))
        assert set(steps["step"] % 3) == {int(environment)}
        first, last = (int(steps["step"][i]) // 3 for i in (0, -1))
        assert first == own["step"][0] // 3 + int(offset)
        assert last >= own["step"][0] // 3
    assert "4" in [episode for episode, *_ in panels]


def test_agents_are_shown_by_name(loops_client, loops):
    shown = part(loops_client, "game/replay/train/1")
    assert [words["agent"] for words in shown["actions"]] == ["agent_0", "agent_1", "agent_2"]
    steps = steps_of(loops, "game", "train", 1)
    assert shown["reward"] == pytest.approx(steps["rewards"], rel=1e-4)
    series = [one for one in shown["series"] if one["agent"] == "agent_1"]
    assert series[3]["values"][1:] == pytest.approx(steps["next_observation"]["agent_1"][:, 3], rel=1e-4)
    found, problem = pictures(loops_client, "game/replay/train/1")
    assert (len(found), problem) == (13, "")


def test_extras_are_shown_before_the_step_that_they_were_recorded_with(tmp_path):
    env, rng = gymnasium.make("CartPole-v1"), np.random.default_rng(0)
    logits = rng.normal(size=(200, 2))
    with runner.record(env, tmp_path / "r", name="mind") as rec:
        rec.reset(seed=1)
        for t in range(200):
            extras = {"logits": logits[t], "value": 2.0} if t != 3 else {"logits": logits[t]}
            *_, over, _, _ = rec.step(t % 2, extras=extras)
            if over:
                break
    with serving(tmp_path / "r") as client:
        shown = {one["name"]: one for one in part(client, "mind/replay/train/0")["series"]}
    assert shown["value"]["kind"] == "extras"
    assert shown["value"]["values"] == [2 if k != 3 else None for k in range(t + 1)] + [None]
    assert shown["logits[1]"]["values"][:-1] == pytest.approx(logits[: t + 1, 1], rel=1e-4)


def test_texts_and_values_of_varying_length_are_shown_as_words(tmp_path):
    with runner.record(gymnasium.make("CartPole-v1"), tmp_path / "r", name="mind") as rec:
        rec.reset(seed=1)
        for t in range(5):
            rec.step(t % 2, extras={"tokens": np.arange(t)} if t != 3 else {"thought": "left?"})
    with serving(tmp_path / "r") as client:
        assert page(client, "/runs/mind/replay/train/0")
        shown = {one["name"]: taken(one) for one in part(client, "mind/replay/train/0")["texts"]}
    assert shown == {
        "tokens": ["[]", "[0]", "[0, 1]", "", "[0, 1, 2, 3]", ""],
        "thought": ["", "", "", "left?", "", ""],
    }


def test_without_a_picture_the_page_gives_the_reason_and_the_values(loops_client):
    """An environment of somebody else's own is not imported."""
    known = set(sys.modules)
    text = page(loops_client, "/runs/rooms/replay/train/0?t=2")
    assert "There is no picture." in text
    assert "data-pictures" not in text
    shown = part(loops_client, "rooms/replay/train/0")
    assert [one["name"] for one in shown["texts"]] == ["mission"]
    assert "position[1]" in [one["name"] for one in shown["series"]]
    found, problem = pictures(loops_client, "rooms/replay/train/0")
    assert found == []
    assert problem.startswith("There is no picture.")
    assert {name for name in set(sys.modules) - known if name.startswith("tests.")} == set()


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("pole/replay/train/99", "no training episode 99"),
        ("pole/replay/eval/4/9", "no trial 9"),
        ("pole/replay/eval/3/0", "nearest after 4"),
        ("poles/replay/train/9999", "no training episode 9,999"),
    ],
)
def test_an_episode_that_is_not_there_is_refused(loops_client, address, message):
    for path in (f"/api/v1/runs/{address}", f"/api/v1/runs/{address}/pictures"):
        answer = loops_client.get(path)
        assert answer.status_code == 404, path
        assert message in answer.json()["error"]["message"]
    assert message in page(loops_client, f"/runs/{address}", 404)


@pytest.mark.parametrize(("at", "phase", "number"), [("2:1", "train", 2), ("eval:4:1", "eval", 1)])
def test_rerun_draws_the_episode_that_it_is_opened_at(loops_client, loops, tmp_path, at, phase, number):
    chunk = pytest.importorskip("rerun.chunk")
    frame = page(loops_client, f"/runs/pole/rerun/frame?at={at}")
    address = html.unescape(re.search('data-recording="([^"]+)"', frame)[1])
    (tmp_path / "run.rrd").write_bytes(loops_client.get(address).content)
    chunks = chunk.RrdReader(str(tmp_path / "run.rrd")).store().stream().to_chunks()
    pictured = {
        time
        for piece in chunks
        if str(piece.entity_path) == f"/{phase}/frame"
        for time in piece.to_record_batch().column("step").to_pylist()
    }
    times = steps_of(loops, "pole", phase, number)["log_time"] // schema.STEP_NANOSECONDS
    assert set(times.tolist()) <= pictured
    assert len(pictured) <= len(times) + 2, "those of no other episode, before and after it"
