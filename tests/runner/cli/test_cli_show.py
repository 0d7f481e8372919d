"""`dualtaxi show`."""

import json
import math
import os
import re
import shutil

import gymnasium
import pytest

import runner
from runner.integrations.tensorboard import SummaryWriter
from runner.runs.run import RUN_FILE, create_run


def _numbers(value):
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        for item in value:
            yield from _numbers(item)
    elif isinstance(value, float):
        yield value


def test_json_is_complete(recorded, recorded_run):
    values = recorded.json("show", "tiny")
    summary = recorded_run.summary
    for key in ("content_digest", "train_steps", "eval_steps", "bytes", "seconds", "episodes"):
        assert values[key] == summary[key]
    assert values["status"] == "finished"
    assert values["run_id"] == recorded_run.run_id
    assert values["config"] == recorded_run.facts["config"]
    assert next(iter(values["config"])) == "name"
    assert values["provenance"]["python"]
    assert [table["agent"] for table in values["tables"]] == ["taxi_1", "taxi_2"]
    assert all(math.isfinite(number) for number in _numbers(values))


def test_json_has_the_whole_series(recorded):
    values = recorded.json("show", "@latest")
    assert [evaluation["episode"] for evaluation in values["eval"]] == [0, 10, 20, 30]
    for evaluation in values["eval"]:
        assert evaluation["trials"] == 5
        assert 0 <= evaluation["success_percent"] <= 100
        assert 1 <= evaluation["mean_length"] <= 40
        assert evaluation["mean_returns"].keys() == {"taxi_1", "taxi_2"}
        assert {
            "collision",
            "taxi_1.drop_off",
            "taxi_2.drop_off",
            "taxi_1.wrong_stop",
            "taxi_2.illegal_pickup",
            "taxi_1.illegal_drop_off",
        } <= evaluation["events"].keys()
    assert values["eval"][0]["training"]["mean_length"] is None  # no episode yet
    steps = [report["step"] for report in values["train"]]
    assert steps == list(range(200, values["train_steps"] + 1, 200))
    assert values["train"][0]["percent_filled"].keys() == {"taxi_1", "taxi_2"}


def test_the_text_compares_with_a_random_policy(recorded):
    assert "A random policy succeeds in " in recorded("show", "tiny").stdout


def test_text_shows_the_same(recorded, recorded_run):
    result = recorded("show", recorded_run.run_id)
    assert result.exit_code == 0
    for values in (
        recorded_run.summary["content_digest"],
        "Evaluations",
        "Tables",
        "Configuration",
        "Provenance",
    ):
        assert values in result.stdout
    assert "name: tiny" in result.stdout
    assert "taxi_2  " in result.stdout
    assert all(line == line.rstrip() for line in result.stdout.splitlines())


@pytest.mark.parametrize("how", ["id", "prefix", "name", "latest", "named latest", "folder", "file"])
def test_a_run_is_found_by_id_prefix_name_and_path(recorded, recorded_run, how):
    name = {
        "id": recorded_run.run_id,
        "prefix": recorded_run.run_id[:3],
        "name": "tiny",
        "latest": "@latest",
        "named latest": "tiny@latest",
        "folder": recorded_run.folder,
        "file": recorded_run.recording,
    }[how]
    assert recorded.json("show", name)["run_id"] == recorded_run.run_id


def test_an_unknown_run_is_refused_with_the_nearest(recorded):
    result = recorded("show", "tinny")
    assert result.exit_code == 2
    assert "no run 'tinny'" in result.stderr
    assert "Did you mean 'tiny'?" in result.stderr


def test_a_name_of_several_runs_is_the_newest_unless_a_command_changes_the_run(command, tiny):
    ids = [command.json("run", tiny)["run_id"] for _ in range(2)]
    for verb in ("show", "verify"):
        result = command(verb, "tiny")
        assert result.exit_code == 0, result.stderr
        assert ids[1] in result.stdout
        assert f"2 runs are named tiny: the newest is taken, {ids[1]}." in result.stderr
        assert "named tiny" not in command(verb, "tiny@latest").stderr
    result = command("label", "tiny", "--tag", "keep")
    assert result.exit_code == 2
    assert all(run_id in result.stderr for run_id in ids)


def test_a_recording_alone_shows_all_but_the_duration(recorded_run, command, tmp_path):
    alone = tmp_path / "alone.mcap"
    shutil.copy(recorded_run.recording, alone)
    values = command.json("show", alone)
    assert values["run_id"] == recorded_run.run_id
    assert values["content_digest"] == recorded_run.summary["content_digest"]
    assert command("show", alone).exit_code == 0


def test_a_run_that_was_cut_off(recorded_run, command):
    folder = command.recordings / recorded_run.run_id
    shutil.copytree(recorded_run.folder, folder)
    content = (folder / "recording.mcap").read_bytes()
    (folder / "recording.mcap").write_bytes(content[: len(content) * 9 // 10])
    facts = json.loads((folder / RUN_FILE).read_text())
    facts |= {"status": "running", "owner": {"host": "elsewhere"}, "summary": {}}
    (folder / RUN_FILE).write_text(json.dumps(facts))
    values = command.json("show", "@latest")
    assert values["content_digest"] is None
    assert values["train_steps"] > 0
    assert command("show", "@latest").exit_code == 0


def test_a_finished_run_says_that_its_recording_is_cut_off(recorded_run, command):
    folder = command.recordings / recorded_run.run_id
    shutil.copytree(recorded_run.folder, folder)
    assert "damage" not in command("show", "@latest").stdout
    content = (folder / "recording.mcap").read_bytes()
    for kept in (len(content) * 9 // 10, 100):
        (folder / "recording.mcap").write_bytes(content[:kept])
        shown = command("show", "@latest").stdout
        assert "cut off" in re.search("^damage .*$", shown, re.MULTILINE)[0]
        assert "cut off" in command.json("show", "@latest")["damage"]


def test_a_plot_and_a_report_give_the_reason_that_show_gives(recorded_run, command, tmp_path):
    folder = command.recordings / recorded_run.run_id
    shutil.copytree(recorded_run.folder, folder)
    os.truncate(folder / "recording.mcap", recorded_run.recording.stat().st_size * 9 // 10)
    damage = command.json("show", "@latest")["damage"]
    assert damage in command("plot", "@latest", "-o", tmp_path / "plot.svg").stderr
    assert damage in command("report", "@latest", "-o", tmp_path / "report.html").stderr


def test_a_report_has_the_results_that_show_has(command, tmp_path):
    with runner.record(gymnasium.make("CartPole-v1"), command.recordings, name="loop") as rec:
        rec.reset(seed=0)
        rec.step(0, extras={"value": 0.5})
        rec.log("loss", 0.25)
        rec.checkpoint("policy", b"weights")
    shown = command("show", "loop").stdout
    command("report", "loop", "-o", tmp_path / "report.html")
    report = (tmp_path / "report.html").read_text()
    for text in ("Checkpoints", "Last results", "Values recorded with steps", "(no episode ended)"):
        assert text in shown
        assert text in report


def test_markdown_has_the_same_sections(recorded):
    text = recorded("show", "tiny").stdout
    shown = recorded("show", "tiny", "--markdown").stdout
    for title in re.findall("^## (.*)$", shown, re.MULTILINE)[1:]:
        assert f"\n{title}\n" in text
    assert "- status: finished, begun " in shown
    assert "```\nname: tiny\n" in shown


def test_a_run_without_a_recording(command, tiny):
    from runner.api import experiment_of

    run = create_run(command.recordings, experiment_of(tiny), 3).update(
        status="failed", summary={"error": "why"}
    )
    values = command.json("show", run.run_id)
    assert (values["status"], values["eval"], values["content_digest"]) == ("failed", [], None)
    result = command("show", run.run_id)
    assert "why" in result.stdout
    assert "no recording" in result.stdout


def test_a_damaged_recording_is_reported_without_a_traceback(command, tmp_path):
    (tmp_path / "noise.mcap").write_bytes(b"noise" * 100)
    result = command("show", tmp_path / "noise.mcap")
    assert result.exit_code == 2
    assert "noise.mcap" in result.stderr
    assert "Traceback" not in result.output


def test_a_run_of_values_alone_is_shown_without_steps_and_episodes(command_in, tmp_path):
    with SummaryWriter(recordings=tmp_path, monitor_gym=False) as writer:
        writer.add_scalar("loss", 0.5, 3)
    shown = command_in(tmp_path)("show", writer.run.run_id).stdout
    assert "Logged last: loss  0.5" in shown
    assert "of training" not in shown
    assert "episode" not in shown
