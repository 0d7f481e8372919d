"""Commands on recorded loops: listing, plots, playing, comparison, verification."""

from __future__ import annotations

import json
import re
import shutil

import gymnasium
import numpy as np
import pytest
from starlette.testclient import TestClient

import runner
from runner.analysis.contents import shortcomings
from runner.analysis.episodes import EpisodeRef
from runner.analysis.evaluations import loop_summary
from runner.analysis.series import read_series
from runner.export.reports.playback import playback_of
from runner.export.values import observations_of
from runner.recording.reader import open_recording
from runner.recording.run_file import Summary
from runner.service.app import create_app
from runner.service.settings import ServiceSettings
from tests.runner.loops.making import dualtaxi, make, play

NEITHER = {"seed": None, "options": None}


def test_the_seed_and_the_options_of_resets_are_shown(tmp_path):
    with runner.record(make("CartPole-v1"), tmp_path, name="reset") as rec:
        for seed, options in ((7, {"low": -0.01, "high": np.float32(0.03125)}), (None, None)):
            rec.reset(seed=seed, options=options)
            while not any(rec.step(0)[2:4]):
                pass
    words = 'seed 7 and options {"low": -0.01, "high": 0.03125}'
    given = {"seed": 7, "options": {"low": -0.01, "high": 0.03125}}
    shown = " ".join(dualtaxi(tmp_path, "show", "reset").output.split())
    assert f"training with {words}" in shown
    assert json.loads(dualtaxi(tmp_path, "show", "reset", "--json").output)["first_resets"] == {
        "train": given
    }
    starts = ("0", given, f"the start, reset with {words}\n"), ("1", NEITHER, "the start\n")
    for episode, reset, start in starts:
        chosen = ("play", "reset", "--episode", episode)
        assert start in dualtaxi(tmp_path, *chosen).output
        first, second, *_ = map(json.loads, dualtaxi(tmp_path, *chosen, "--json").output.splitlines())
        assert (first["reset"], "reset" in second) == (reset, False)
    with open_recording(rec.run.recording) as recording:
        descriptions = [playback_of(recording, EpisodeRef(episode)).description for episode in (0, 1)]
    assert descriptions[0].endswith(f" Reset with {words}.")
    assert "eset" not in descriptions[1]


class Counting(gymnasium.Env):
    """Counts its steps, ends every third time, and counts on if it is not reset."""

    observation_space = gymnasium.spaces.Box(0, 100, (1,), np.float64)
    action_space = gymnasium.spaces.Discrete(2)
    count = 0.0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0.0
        return np.array([self.count]), {}

    def step(self, action):
        self.count += 1
        return np.array([self.count]), 1.0, self.count % 3 == 0, False, {}


def test_an_episode_without_a_reset_begins_where_the_one_before_ended(tmp_path):
    with runner.record(Counting(), tmp_path, name="on") as rec:
        rec.reset(seed=7)
        for _ in range(6):
            rec.step(0)
    with open_recording(rec.run.recording) as recording:
        for episode, values in enumerate(([0, 1, 2, 3], [3, 4, 5, 6])):
            assert [seen[0] for seen, _ in observations_of(recording, "train", episode)] == values
        playback = playback_of(recording, EpisodeRef(1))
    assert "eset" not in playback.description
    assert playback.series[0].values == [3, 4, 5, 6]
    first, *_ = dualtaxi(tmp_path, "play", "on", "--episode", "1", "--json").output.splitlines()
    assert "reset" not in json.loads(first)


def test_ls_and_show_describe_loops(folder):
    listed = json.loads(dualtaxi(folder, "ls", "--json").stdout)["runs"]
    assert {run["name"] for run in listed} == {"lake", "again", "other", "pole", "rooms"}
    reply = json.loads(dualtaxi(folder, "show", "pole", "--json").stdout)
    assert (reply["train_steps"], reply["eval_steps"]) == (400, 60)
    assert reply["config"]["made_by"] == "runner.record"
    assert dualtaxi(folder, "show", "rooms").exit_code == 0


@pytest.mark.parametrize("name", ["lake", "pole", "rooms"])
def test_ls_and_show_have_the_returns_of_a_loop_and_what_it_logged(folder, name):
    with open_recording(runner.find_run(name, folder).recording) as recording:
        trials = recording.eval.episodes.array(0, None)
        episodes = recording.train.episodes.array(0, None)[-100:]
    row = next(
        run for run in json.loads(dualtaxi(folder, "ls", "--json").stdout)["runs"] if run["name"] == name
    )
    assert row["mean_return"] == pytest.approx(trials["returns"].sum(axis=1).mean())
    assert row["mean_length"] == pytest.approx(trials["length"].mean())
    assert row["logged"].keys() == {"loss"}
    assert (row["success_percent"] is None) == (name != "lake")
    listed = dualtaxi(folder, "ls", "--columns", "name,mean_return,logged", name).stdout
    assert f"{row['mean_return']:,.1f}" in listed
    assert f"loss {row['logged']['loss']:.4g}" in listed

    shown = json.loads(dualtaxi(folder, "show", name, "--json").stdout)
    assert [record["trials"] for record in shown["eval"]] == [len(trials)]
    assert shown["eval"][0]["mean_length"] == pytest.approx(trials["length"].mean())
    assert shown["loop"]["logged"] == row["logged"]
    recent = shown["loop"]["recent_training"]
    assert recent["episodes"] == len(episodes)
    assert recent["mean_return"] == pytest.approx(episodes["returns"].sum(axis=1).mean())
    text = dualtaxi(folder, "show", name).stdout
    assert "Evaluations" in text
    returns = re.search(r"^Mean return of the last ([\d,]+) training episodes +(.*)$", text, re.MULTILINE)
    assert returns.groups() == (f"{recent['episodes']:,}", f"{recent['mean_return']:,.1f}")
    assert "Logged last: loss" in text


@pytest.mark.parametrize("name", ["lake", "pole", "rooms"])
def test_the_summary_of_a_loop_equals_that_of_its_recording(folder, name):
    run = runner.find_run(name, folder)
    with open_recording(run.recording) as recording:
        counted = loop_summary(recording)
        assert counted.last_evaluation.as_json() == pytest.approx(recording.result["last_evaluation"])
        assert vars(counted.recent_training) == pytest.approx(recording.result["recent_training"])
        recording.result = Summary()  # as in recordings made before, which say nothing of logged values
        assert loop_summary(recording).logged == counted.logged


def test_a_report_of_a_loop_has_no_learning_section(folder, tmp_path):
    dualtaxi(folder, "report", "lake", "-o", str(tmp_path / "report.html"))
    page = (tmp_path / "report.html").read_text()
    assert "by trial and error" not in page
    assert "A loop over FrozenLake-v1" in page
    assert "No evaluation was recorded" not in page
    assert '<th scope="col">trials</th>' in page
    assert "What was learned" not in page


def test_pages_of_a_loop_show_its_evaluations_and_link_to_their_replays(folder, tmp_path):
    settings = ServiceSettings(recordings=(folder,), tokens=tmp_path / "tokens.json")
    with TestClient(create_app(settings), base_url="http://localhost") as client:

        def page(address):
            answer = client.get(address, headers={"Accept": "text/html"})
            assert answer.status_code == 200
            return answer.text

        for name in ("lake", "pole"):
            evaluations = page(f"/runs/{name}/evaluations")
            assert "No evaluation was recorded" not in evaluations
            for address in re.findall(r'href="(/runs/\w+/replay/[^"]+)"', evaluations):
                assert "step 0 of" in page(address)
            assert re.search(r"/replay/train/0\b", page(f"/runs/{name}/episodes"))
            overview = page(f"/runs/{name}")
            assert "Mean return in the last evaluation" in overview
            assert "Logged last: loss" in overview
            assert "<dd>–</dd>" not in overview
        compared = page("/compare?run=lake&run=pole")
        assert "Mean return in the last evaluation" in compared
        assert "Q-tables" not in compared
        assert "There are none to compare." in page("/compare/tables?run=lake&run=pole")
        answer = client.get("/api/v1/runs/pole/evaluations").json()
        assert answer["total"] == len(answer["records"]) == 1


@pytest.mark.parametrize("name", ["lake", "pole", "rooms"])
def test_plot_and_report_draw_loops(folder, name, tmp_path):
    plotted = dualtaxi(folder, "plot", name, "-o", str(tmp_path / "plot.svg"))
    assert plotted.exit_code == 0
    drawn = (tmp_path / "plot.svg").read_text()
    assert "Logged: loss" in drawn
    assert "Return of training episodes" in drawn
    assert "Return of evaluation trials" in drawn
    assert dualtaxi(folder, "report", name, "-o", str(tmp_path / "report.html")).exit_code == 0
    page = (tmp_path / "report.html").read_text()
    assert "from a loop" in page
    assert "no steps were recorded" not in page
    assert "No evaluation was recorded" not in page


@pytest.mark.parametrize("name", ["lake", "pole", "rooms"])
def test_verify_checks_what_can_be_checked(folder, name):
    reply = dualtaxi(folder, "verify", name)
    assert reply.exit_code == 0
    assert "reproduced" in reply.output


def test_verify_finds_a_digest_that_does_not_match_the_messages(folder, tmp_path):
    from runner.execution.verify import verify
    from runner.recording.rewriting import rewrite

    def other(name: str, entries: dict[str, str]) -> dict[str, str]:
        if name != "result":
            return entries
        result = json.loads(entries["json"])
        return {"json": json.dumps(result | {"content_digest": "0" * 64}, sort_keys=True)}

    altered = tmp_path / "recording.mcap"
    rewrite(runner.find_run("pole", folder).recording, altered, other)
    assert "content_digest: found 000" in verify(altered).finding


@pytest.mark.parametrize(
    "words",
    [
        ("evaluate", "pole"),
        ("qtable", "lake"),
    ],
    ids=" ".join,
)
def test_commands_that_need_a_job_refuse_a_loop(folder, words):
    done = dualtaxi(folder, *words)
    assert done.exit_code == 2
    assert "loop" in done.output


def test_the_table_of_a_loop_is_its_latest_snapshot(tmp_path):
    q, taken = np.zeros((16, 4)), []
    with runner.record(gymnasium.make("FrozenLake-v1"), tmp_path, name="table") as rec:
        state, _ = rec.reset(seed=0)
        for step in range(60):
            action = step % 4
            after, _, terminated, truncated, _ = rec.step(action)
            q[state, action] += 1
            taken.append((state, action))
            state = rec.reset()[0] if terminated or truncated else after
            if step in (19, 49):
                rec.snapshot("q", q)
                rec.snapshot("weights", q[:3])
    assert "q  " in (shown := dualtaxi(tmp_path, "qtable", "table").stdout)
    assert "the latest snapshot, after 50 steps" in shown
    words = ("qtable", "table", "--step", "30", "--state", "0", "--json", "-o", tmp_path / "q.npy")
    found = json.loads(dualtaxi(tmp_path, *words).stdout)
    assert (found["step"], found["visits"]) == (30, sum(state == 0 for state, _ in taken[:20]))
    assert [table["snapshot_step"] for table in found["tables"]] == [20]
    visits = [taken[:20].count((0, action)) for action in range(4)]
    assert [row["value"] for row in found["values"]] == [row["visits"] for row in found["values"]] == visits
    assert np.load(tmp_path / "q.npy")[0].tolist() == visits
    for words, message in (("--step", "5"), "no table after 5 of 60"), (("--step", "61"), "61 of 60"):
        refused = dualtaxi(tmp_path, "qtable", "table", *words)
        assert (refused.exit_code, message in refused.output) == (2, True)
    dualtaxi(tmp_path, "report", "table", "-o", tmp_path / "report.html")
    settings = ServiceSettings(recordings=(tmp_path,))
    with TestClient(create_app(settings), base_url="http://localhost") as client:
        head = client.get(f"/runs/{rec.run.run_id}").text
        page = client.get(f"/runs/{rec.run.run_id}/learned").text
        table = client.get(f"/api/v1/runs/{rec.run.run_id}/qtable", params={"step": 30, "state": 0}).json()
    assert f"/runs/{rec.run.run_id}/learned" in head
    for text in ((tmp_path / "report.html").read_text(), page):
        assert "Greedy actions of player" in text
        assert "At the last snapshot" in text
    assert table == {key: value for key, value in found.items() if key != "files"}


def test_an_evaluation_of_a_loop_is_played(folder):
    with open_recording(runner.find_run("lake", folder).recording) as recording:
        trained = recording.train.episodes.count()
        second = recording.eval.episode_steps(1)["state"].tolist()
    done = dualtaxi(folder, "play", "lake", "--eval", f"{trained}:1", "--json")
    assert done.exit_code == 0, done.output
    assert [json.loads(line)["state"] for line in done.stdout.splitlines()] == second
    assert f"it has 1, the nearest after {trained}" in dualtaxi(folder, "play", "lake", "--eval", "1").output


def test_the_grid_of_a_loop_is_played(folder):
    done = dualtaxi(folder, "play", "lake", "--episode", "2")
    assert done.exit_code == 0
    assert "player" in done.stdout


def test_the_steps_of_any_loop_are_played(folder):
    for name in ("pole", "rooms"):
        with open_recording(runner.find_run(name, folder).recording) as recording:
            length = int(recording.train.episodes.array(1, 2)[0]["length"])
            steps = [step for step in recording.train.transitions() if step["episode"] == 1]
        frames = (
            dualtaxi(folder, "play", name, "--episode", "1").stdout.rstrip().split(f"\n\n{name}, seed 0: ")
        )
        assert len(frames) == length + 1
        assert frames[-1].splitlines()[1] == f"step {length} of {length}"
        assert f"reward {steps[-1]['rewards'][0]:g}, so far" in frames[-1]
        lines = dualtaxi(folder, "play", name, "--episode", "1", "--json").stdout.splitlines()
        played = [json.loads(line) for line in lines]
        assert [line["rewards"]["agent"] for line in played] == [step["rewards"][0] for step in steps]
        if name == "pole":
            observations = np.array([line["next_observation"] for line in played], np.float32)
            np.testing.assert_array_equal(observations, [step["next_observation"] for step in steps])
            names = ["left", "right"]
            shown = [frame.splitlines()[4] for frame in frames[1:]]
            assert shown == [names[int(step["action"])] for step in steps]
        else:
            missions = [step["next_observation"]["mission"] for step in steps]
            assert [line["next_observation"]["mission"] for line in played] == missions
            assert all(repr(mission) in frame for mission, frame in zip(missions, frames[1:], strict=True))


def test_a_killed_loop_is_listed_repaired_and_compared(folder, tmp_path):
    whole = runner.find_run("pole", folder)
    cut = tmp_path / "k" / "recording.mcap"
    cut.parent.mkdir()
    cut.write_bytes(whole.recording.read_bytes()[:-2000])
    for words in (("ls",), ("show", str(cut)), ("verify", str(cut))):
        dualtaxi(tmp_path, *words)
    mended = dualtaxi(tmp_path, "repair", str(cut))
    assert "resets" in mended.output
    assert dualtaxi(tmp_path, "show", str(cut)).exit_code == 0
    assert dualtaxi(tmp_path, "diff", str(cut), str(whole.recording)).exit_code in (0, 1)


def test_an_interrupted_loop_is_not_resumed(tmp_path):
    env = runner.record(make("FrozenLake-v1"), tmp_path, name="cut")
    list(play(env, 50))
    env._loop.close("interrupted")
    before = env.run.recording.read_bytes()
    done = dualtaxi(tmp_path, "resume", "cut")
    assert done.exit_code == 2
    assert "which alone can repeat it" in done.output
    assert env.run.recording.read_bytes() == before


def test_a_loop_without_steps_gets_no_impossible_hints(tmp_path):
    with runner.record(make("FrozenLake-v1"), tmp_path, name="none") as env:
        env.reset(seed=0)
        env._loop.close("failed")
    film = dualtaxi(tmp_path, "export", "film", "none", "-o", str(tmp_path / "x.gif"))
    assert film.exit_code == 2
    assert "loop" in film.output
    assert "dualtaxi re" not in film.output
    again = dualtaxi(tmp_path, "rerecord", "none")
    assert again.exit_code == 0
    assert "has all its steps already" in again.output


@pytest.mark.parametrize("value", [float("inf"), float("-inf"), float("nan"), 1e308])
def test_values_that_are_not_finite_are_left_out_of_curves_and_counted(value, tmp_path):
    """An infinite reward must not end `plot` and `report` in a traceback."""
    env = gymnasium.wrappers.TransformReward(make("FrozenLake-v1"), lambda reward: value or reward)
    with runner.record(env, tmp_path, name="bad") as recorded:
        list(play(recorded, 40, 0))
        recorded.log("loss", value)
        value = 0.0
        list(play(recorded, 200, 1))
        recorded.log("loss", 0.25)
    message = "“Return of training episodes”, 1 value of “Logged: loss”."
    for command, file in (("plot", "plot.svg"), ("report", "report.html")):
        done = dualtaxi(tmp_path, command, "bad", "-o", str(tmp_path / file))
        assert done.exit_code == 0
        assert message in done.stderr
        assert "Return of training episodes" in (tmp_path / file).read_text()
    with open_recording(runner.find_run("bad", tmp_path).recording) as recording:
        series = read_series(recording)
    drawn = [
        reading
        for _, readings in series.training
        for lines in readings.values()
        for reading in lines.values()
    ]
    assert np.isfinite(drawn).all()
    assert 0.25 in drawn
    assert series.not_finite["training.mean_return"] >= 1


def test_a_new_name_is_in_every_picture_report_and_export(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "runs")
    dualtaxi(tmp_path / "runs", "label", "lake", "--name", "mountain")
    run = runner.find_run("mountain", tmp_path / "runs")
    with open_recording(run.recording) as recording:
        assert recording.name == read_series(recording).name == "mountain"
    for words in (("plot", "mountain", "-o", "plot.svg"), ("report", "mountain", "-o", "report.html")):
        made = tmp_path / words[-1]
        assert dualtaxi(tmp_path / "runs", *words[:-1], str(made)).exit_code == 0
        assert "mountain" in made.read_text()
        assert "lake, seed" not in made.read_text()
    reply = json.loads(dualtaxi(tmp_path / "runs", "diff", "mountain", "other", "--json").stdout)
    assert (reply["a"]["name"], reply["b"]["name"]) == ("mountain", "other")


def test_a_running_loop_is_listed_as_running(tmp_path):
    with runner.record(make("CartPole-v1"), tmp_path / "runs", name="now") as env:
        list(play(env, 300, 0))
        env.commit() if hasattr(env, "commit") else None
        run = runner.find_run("now", str(tmp_path / "runs"))
        assert run.status == "running"
        if run.recording.exists():
            with open_recording(run.recording) as recording:
                assert recording.status == "running"
                assert "is still running" in shortcomings(recording)[0]
    with open_recording(run.recording) as recording:
        assert recording.status == "finished"


def test_a_run_is_found_by_text_and_in_the_usual_folder(folder, monkeypatch):
    found = runner.find_run("lake", str(folder))
    monkeypatch.setenv("DUALTAXI_RECORDINGS", str(folder))
    assert runner.find_run("lake") == found
    assert {run.run_id for run in runner.list_runs()} == {run.run_id for run in runner.list_runs(folder)}
    assert found.run_id in repr(found)
    assert len(repr(found)) < 300
