"""`dualtaxi play`."""

import json
import shutil
import sys

import gymnasium
import pytest
from click.testing import CliRunner

import runner
from runner.analysis.episodes import EpisodeRef
from runner.cli import cli
from runner.execution.verify import verify
from tests.runner.altering import altered
from tests.runner.loops.making import play


def _frames(text):
    return text.rstrip().split("\n\ntiny, seed 3: ")


def test_json_is_a_line_for_each_step(recorded, recorded_run):
    result = recorded("play", "tiny", "--episode", 7, "--json")
    lines = [json.loads(line) for line in result.stdout.splitlines()]
    with runner.open_recording(recorded_run.recording) as recording:
        steps = recording.train.episode_steps(7)
    assert [line["state"] for line in lines] == steps["state"].tolist()
    assert [list(line["rewards"].values()) for line in lines] == steps["rewards"].tolist()
    assert [line["t"] for line in lines] == list(range(len(steps)))
    assert lines[0]["state_in_words"].startswith("taxi 1 (")
    assert " + " in lines[0]["action_in_words"]
    masks = [sum(1 << ["taxi_1", "taxi_2"].index(agent) for agent in line["explored"]) for line in lines]
    assert masks == steps["explored"].tolist()


def test_events_are_those_that_the_episode_counts(recorded, recorded_run):
    lines = [
        json.loads(line) for line in recorded("play", "tiny", "--episode", 7, "--json").stdout.splitlines()
    ]
    counted = runner.frames.episodes(recorded_run).loc[7]
    names = [name for name in counted.index if "taxi_" in name and not name.startswith("return.")]
    assert len(names) == 10
    for name in [*names, "collision"]:
        assert sum(name in line["events"] for line in lines) == counted[name]


def test_frames_come_one_after_another_without_waiting(recorded):
    result = recorded("play", "tiny", "--episode", 0)
    frames = _frames(result.stdout)
    assert result.exit_code == 0
    assert frames[0].startswith("tiny, seed 3: training episode 0\nstep 0 of ")
    assert len(frames) == int(frames[0].splitlines()[1].split()[-1]) + 1
    assert "\x1b" not in result.stdout
    for frame in frames:
        assert frame.count("+-----+-----+-----+-----+") == 2
        assert all(sign in frame for sign in ("R", "G", "Y", "B", "1", "2", "*"))
        assert "taxi 1 (" in frame
    assert "reward " in frames[1]


def test_the_typical_trial_of_the_last_evaluation_is_played_by_default(recorded, recorded_run):
    with runner.open_recording(recorded_run.recording) as recording:
        typical = EpisodeRef.parse("typical").resolved(recording)
    assert typical.title in recorded("play", "tiny").stdout


@pytest.mark.parametrize(("trial", "number"), [("20:3", 3), ("20", 0)])
def test_a_trial_of_an_evaluation(recorded, recorded_run, trial, number):
    result = recorded("play", "tiny", "--eval", trial, "--json")
    states = [json.loads(line)["state"] for line in result.stdout.splitlines()]
    with runner.open_recording(recorded_run.recording) as recording:
        assert states == recording.eval.episode_steps(2 * 5 + number)["state"].tolist()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--eval", "21:0"], "found no evaluation after 21 episodes; it has 4, the nearest after 20"),
        (["--eval", "20:5"], "found no trial 5 of the evaluation after 20 episodes; it has 5, from 0"),
        (["--eval", "x"], "expected N:TRIAL"),
        (["--eval", "3:x"], "expected N:TRIAL"),
        (
            ["--episode", "1:x"],
            "expected EPISODE:T such as 120:5, step:N, or eval:N:TRIAL:T",
        ),
        (["--episode", "1:5000"], "steps, from 0; found no step 5,000"),
        (["--episode", "30"], "no training episode 30"),
        (["--episode", "-1"], "--episode"),
        (["--speed", "0"], "--speed"),
        (["--episode", "1", "--eval", "20:0"], "--episode and --eval exclude each other"),
        (["--best", "--worst"], "--best and --worst exclude each other"),
    ],
)
def test_missing_episodes_are_refused(recorded, words, message):
    result = recorded("play", "tiny", *words)
    assert result.exit_code == 2
    assert message in result.stderr


@pytest.mark.parametrize("words", [("--episode", "7:3"), ("--eval", "20:3:2")])
def test_an_episode_is_played_from_a_step_on(recorded, words):
    episode, _, step = words[1].rpartition(":")
    whole = recorded("play", "tiny", words[0], episode, "--json").stdout.splitlines()
    assert recorded("play", "tiny", *words, "--json").stdout.splitlines() == whole[int(step) :]
    assert recorded("play", "tiny", *words).stdout.count("\nstep ") == len(whole) + 1 - int(step)


def test_the_best_and_the_worst_trial(recorded, recorded_run):
    with runner.open_recording(recorded_run.recording) as recording:
        returns = recording.eval.episodes.array()["returns"].sum(axis=1)
    for option, value in (("--best", returns.max()), ("--worst", returns.min())):
        steps = map(json.loads, recorded("play", "tiny", option, "--json").stdout.splitlines())
        assert sum(sum(step["rewards"].values()) for step in steps) == value


def test_without_evaluations_the_last_episode_is_played(command, tiny):
    command("run", tiny, "--set", "evaluation=null")
    assert "training episode 29" in command("play", "@latest").stdout
    result = command("play", "@latest", "--eval", "0:0")
    assert "found no evaluation after 0 episodes; it has none at all" in result.stderr


def test_without_a_scene_states_are_numbers(command, tiny):
    env = "env={id: tests.runner.corridor:Corridor-v0}"
    command("run", tiny, "--set", env, "--set", "mode=cooperative")
    frames = command("play", "@latest", "--episode", 0).stdout
    assert "\nstate 0\n" in frames
    assert "\naction " in frames


def test_without_steps_there_is_nothing_to_play(command, tiny):
    command("run", tiny, "--set", "recording.steps=none")
    result = command("play", "@latest")
    assert result.exit_code == 2
    assert "dualtaxi rerecord" in result.stderr


def test_the_environment_need_not_be_installed(recorded_run, command, tmp_path, monkeypatch):
    alone = shutil.copy(recorded_run.recording, tmp_path / "alone.mcap")
    for name in [name for name in sys.modules if name.partition(".")[0] in ("dualtaxi", "gymnasium")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "dualtaxi", None)
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    assert "taxi 1 (" in command("play", alone).stdout


@pytest.mark.parametrize("start", [None, "x", 10**30])
def test_a_forged_space_without_a_least_number_counts_from_0(start, tmp_path):
    def forged(entries):
        described = json.loads(entries["spaces"])
        described["observation"]["start"] = start
        return entries | {"spaces": json.dumps(described)}

    with runner.record(gymnasium.make("CliffWalking-v1"), tmp_path, name="loop") as rec:
        list(play(rec, 5))
    path = altered(rec.run.recording, tmp_path / "x.mcap", None, lambda messages: messages, run=forged)
    shown = [CliRunner().invoke(cli, ["play", str(each)]).output for each in (rec.run.recording, path)]
    assert shown[0] == shown[1]
    assert "step 5 of 5" in shown[0]
    assert verify(path).finding == ""
