"""Planted causes are found in real jobs, what was trained is kept, and bad input is named."""

from __future__ import annotations

import json
import math
import re
import signal
import subprocess
import sys

import numpy as np
import pytest
from click.testing import CliRunner

import runner
from runner.analysis.statistics import Estimate
from runner.cli import cli
from runner.config import from_mapping
from runner.debugging.explain import EPISODES, RUNS
from runner.debugging.explanation import (
    Explanation,
    Mixture,
    Setting,
    Side,
    explanations_in,
    read_explanation,
    sections,
    signed,
    summary,
)
from runner.debugging.mixtures import mix
from runner.errors import RunnerError
from runner.runs.run import UNLISTED, label, list_runs
from runner.sweep import workers

LAKE = {
    "env": {"id": "FrozenLake-v1", "kwargs": {"is_slippery": False}},
    "episodes": 400,
    "evaluation": {"every": 100, "trials": 10},
    "epsilon": 0.0,
    "discount": 0.0,
}
"""Nothing is learned: without exploring the goal is never reached, and without a discount no path to it."""
PLANTED = {"epsilon": 0.9, "discount": 0.9}
"""Together they solve the lake; neither does alone."""


def explained(a, b, folder, **options):
    return runner.explain(a, b, recordings=folder, **({"seeds": 4, "workers": 1} | options))


def test_a_planted_interaction_is_found(tmp_path):
    b = LAKE | PLANTED | {"quirks": {"bootstrap_after_termination": True}}
    found = explained(LAKE, b, tmp_path)
    assert (found.metric, found.value_a.value, found.value_b.value) == ("success_percent", 0.0, 100.0)
    shares = {setting.name: setting.share.value for setting in found.settings}
    expected = {"epsilon": 50.0, "discount": 50.0, "quirks.bootstrap_after_termination": 0.0}
    assert shares == pytest.approx(expected)
    assert all(setting.alone.value == 0.0 for setting in found.settings)
    (clear,) = [pair for pair in found.interactions if pair.beyond.excludes_zero]
    assert (set(clear.settings), clear.beyond.value) == ({"epsilon", "discount"}, 100.0)
    assert set(found.smallest.settings) == {"epsilon", "discount"}
    assert len(found.mixtures) == 8
    text = "\n".join(line for each in sections(found) for line in each.sentences)
    assert "epsilon and discount together make 100 % of it" in text or "discount and epsilon" in text


def test_a_planted_cause_is_found_with_the_step_that_it_changed_first(tmp_path):
    a, b = LAKE | {"discount": 0.9}, LAKE | PLANTED | {"step_size": 0.5}
    found = explained(a, b, tmp_path)
    assert found.smallest.settings == ("epsilon",)
    strongest = found.settings[0]
    assert (strongest.name, strongest.a, strongest.b) == ("epsilon", "0", "0.9")
    assert strongest.share.value > 90.0
    first = found.first_step
    run_a, run_b = (runner.find_run(run, tmp_path) for run in (first.run_a, first.run_b))
    assert [run.file.config["epsilon"] for run in (run_a, run_b)] == [0.0, 0.9]
    records = []
    for run in (run_a, run_b):
        with runner.open_recording(run.recording) as recording:
            records.append([step for block in recording.train.steps.blocks() for step in block])
    fields = ("state", "action", "explored", "next_state")
    equal = [all(x[name] == y[name] for name in fields) for x, y in zip(*records, strict=False)]
    assert equal.index(False) == first.step


def test_the_values_are_those_of_recorded_runs(tmp_path):
    config = LAKE | PLANTED | {"env": {"id": "FrozenLake-v1", "kwargs": {"is_slippery": True}}}
    found = explained(config, config | {"epsilon": 0.5}, tmp_path, at=300, seeds=3, metric="mean_length")
    for seed, value in zip(found.seeds, found.mixtures[0].values, strict=True):
        run = runner.run(config, seed=seed, recordings=tmp_path)
        evaluations = runner.frames.evaluations(run)
        assert evaluations.set_index("episode")["mean_length"][300] == value


def test_what_was_trained_is_kept(tmp_path):
    b = LAKE | PLANTED | {"step_size": 0.5}

    def interrupt(done, total, what):
        if done >= 12:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        explained(LAKE, b, tmp_path, report=interrupt)
    found = explained(LAKE, b, tmp_path)
    assert 0 < found.trained < found.runs == 32
    (name,) = explanations_in(tmp_path)
    assert read_explanation(name, tmp_path) == found
    again = explained(LAKE, b, tmp_path, seeds=5)
    assert (again.trained, again.runs) == (8, 40)
    assert explained(LAKE, b, tmp_path, seeds=5, metric="mean_length").trained == 0
    assert len(list_runs(tmp_path / UNLISTED)) == 2
    values = tmp_path / ".explain" / name.split("/")[0] / "values.jsonl"
    first, _, others = values.read_text().partition("\n")
    wrong = [first.replace('"seconds": ', f'"seconds": {digits}') for digits in ("9" * 400, 'NaN, "x": ')]
    values.write_text(
        "\n".join(["{", *wrong, first, others[:-30]])
    )  # damaged lines, and one that was cut off
    assert explained(LAKE, b, tmp_path, seeds=5).trained == 1
    assert len(list_runs(tmp_path / UNLISTED)) == 2
    assert list_runs(tmp_path) == []


def test_above_eight_settings_a_minimal_set_is_found(tmp_path):
    b = (
        LAKE
        | PLANTED
        | {
            "step_size": 0.2,
            "initial_q": 1e-9,
            "episodes": 410,
            "exploration": "independent",
            "algorithm": "expected_sarsa",
            "env": {"id": "FrozenLake-v1", "kwargs": {"is_slippery": False, "max_episode_steps": 101}},
            "quirks": {"bootstrap_after_termination": True},
        }
    )
    found = explained(LAKE, b, tmp_path, seeds=2)
    assert found.method == "delta debugging"
    assert len(found.settings) == 9
    assert set(found.smallest.settings) == {"epsilon", "discount"}
    assert {setting.name for setting in found.settings if setting.share} == {"epsilon", "discount"}
    assert len(found.mixtures) < 60
    text = "\n".join(line for section in sections(found) for line in section.sentences)
    assert "there may be a smaller one" in text
    assert "smallest set" not in text
    assert "not in the set" in str(sections(found)[1].grids)


def test_the_part_of_the_smallest_set_has_an_interval_and_few_seeds_that_differ_are_named():
    def mixture(names, *values):
        return Mixture(names, Estimate(float(np.mean(values)), math.nan, math.nan), values)

    zero = Estimate(0.0, 0.0, 0.0)
    whole = mixture(("epsilon", "discount"), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 90.0, 100.0, 110.0)
    part = mixture(("epsilon",), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 80.0, 99.0, 120.0)
    explanation = Explanation(
        name="a-b/success_percent",
        a=Side("a"),
        b=Side("b"),
        metric="success_percent",
        at=None,
        episodes=10,
        seeds=tuple(range(10)),
        method="all mixtures",
        value_a=zero,
        value_b=whole.mean,
        difference=Estimate(30.0, 5.0, 60.0),
        settings=tuple(Setting(name, "0", "1", zero, zero, zero) for name in ("epsilon", "discount")),
        interactions=(),
        smallest=part,
        mixtures=(mixture((), *[0.0] * 10), part, whole),
        first_step=None,
        notes=(),
        trained=0,
        seconds=1.0,
    )
    made = explanation.part_of(part)
    assert made.value == pytest.approx(299 / 300)
    assert made.low < made.value < made.high
    text = " ".join(summary(explanation))
    assert re.search(r"epsilon alone makes 100 % \(\d+ % to \d+ %\) of it: the smallest set", text)
    assert "of 10 seeds, one of 95 % holds 84 to 91 % of the time" in text
    assert "A and B have the same value with 7 of the 10 seeds" in text
    assert signed(zero) == "+0.000"


def test_settings_that_only_go_together_are_one(tmp_path):
    a = {"episodes": 10, "mode": "cooperative"}
    b = {"episodes": 10, "mode": "competitive", "algorithm": "hysteretic_q_learning", "discount": 0.5}
    mixing = mix(from_mapping(a), from_mapping(b))
    names = {factor.name for factor in mixing.factors}
    assert names >= {"discount", "exploration"}
    (together,) = [factor for factor in mixing.factors if len(factor.changes) > 1]
    assert {change.path for change in together.changes} >= {"tables", "rewards", "algorithm", "hysteretic"}
    assert any("only go together" in note for note in mixing.notes)
    for mixture in range(2 ** len(mixing.factors)):
        mixing.config(mixture)
    shared = {"episodes": 10, "mode": "competitive", "exploration": "shared"}
    (mode,) = mix(from_mapping(a), from_mapping(shared)).factors
    assert (mode.name, mode.a, mode.b) == ("mode", "cooperative", "competitive")


MANY = {
    "episodes": 401,
    "step_size": 0.2,
    "discount": 0.3,
    "epsilon": 0.4,
    "initial_q": 0.5,
    "exploration": "independent",
    "algorithm": "expected_sarsa",
    "quirks": {"bootstrap_after_termination": True, "epsilon_exploits": True},
    "env": {
        "id": "FrozenLake-v1",
        "kwargs": {"is_slippery": True, "map_name": "8x8", "max_episode_steps": 7, "success_rate": 0.5}
        | {"reward_schedule": [2, 0, 0]},
    },
}


def test_a_branch_is_put_in_words():
    changed = {"run": "k3v9m2xq", "step": 100_000, "settings": {"epsilon": 0.5}}
    acted = {"run": "k3v9m2xq", "step": 1200, "actions": {"agent": "left"}}
    mixing = mix(from_mapping(LAKE), from_mapping(LAKE | {"branches": [acted, changed]}))
    (factor,) = mixing.factors
    assert factor.b == "agent left at step 1,200; epsilon 0.5 from step 100,000"
    assert factor.a == "none"


def test_a_wrong_metric_is_refused_before_anything_is_trained(tmp_path):
    with pytest.raises(RunnerError, match="expected one that evaluations of both have"):
        explained(LAKE, LAKE | PLANTED, tmp_path, metric="nothing")
    assert list(tmp_path.rglob("values.jsonl")) == []


def test_without_a_clear_difference_no_parts_of_it_are_shown(tmp_path):
    found = explained(LAKE, LAKE | {"epsilon": 0.1}, tmp_path, seeds=2, metric="success_percent")
    (shares,) = [each for each in sections(found) if each.title == "Shares"]
    assert shares.grids[0].headings == ("setting", "A", "B", "share", "alone", "last")
    assert {len(row) for row in shares.grids[0].rows} == {6}


@pytest.mark.parametrize(
    ("b", "options", "message"),
    [
        (LAKE, {}, "differ in no setting"),
        (LAKE | {"evaluation": {"every": 50, "trials": 10}}, {}, "evaluation only measure and record"),
        (LAKE | MANY, {}, "expected at most 12"),
        (LAKE | PLANTED, {"at": 500}, "A trains 400 episodes"),
        (LAKE | PLANTED, {"seeds": 0}, "found 0, expected 1 to 10,000"),
        (LAKE | PLANTED, {"metric": "succes_percent"}, "success_percent"),
        ("tutorial_cooperativ", {}, "tutorial_cooperative"),
        (LAKE | {"env": {"id": "Nowhere-v0"}}, {}, "Nowhere"),
    ],
)
def test_bad_input_is_named(b, options, message, tmp_path):
    with pytest.raises(RunnerError, match=message):
        explained(LAKE, b, tmp_path, **options)


def test_an_ambiguous_name_lists_runs_each_on_its_own_line(tmp_path):
    for seed in (0, 1):
        runner.run(LAKE | {"name": "twice", "seed": seed, "episodes": 10}, recordings=tmp_path)
    with pytest.raises(RunnerError, match=r"matches 2 runs(?s:.*) UTC\nThere is no configuration"):
        explained(LAKE, "twice", tmp_path)


def test_a_loop_is_refused(tmp_path):
    import gymnasium

    env = runner.record(gymnasium.make("FrozenLake-v1"), recordings=tmp_path, name="mine")
    env.reset(seed=1)
    env.step(0)
    env.close()
    with pytest.raises(RunnerError, match="training loop of your own"):
        explained("mine", LAKE, tmp_path)


def test_a_damaged_result_is_named(tmp_path):
    found = explained(LAKE, LAKE | PLANTED, tmp_path, seeds=1)
    assert found.difference.value == 100.0
    path = tmp_path / ".explain" / f"{found.name}.json"
    whole = found.as_json()
    for damaged in ({"name": 3}, whole | {"settings": []}):
        path.write_text(json.dumps(damaged))
        with pytest.raises(RunnerError, match="no longer describes an explanation"):
            read_explanation(found.name, tmp_path)
    with pytest.raises(RunnerError, match="no explanation 'other'"):
        read_explanation("other", tmp_path)


def test_the_command_plans_answers_and_prints_json(tmp_path):
    a, b = tmp_path / "a.yaml", tmp_path / "b.yaml"
    a.write_text(json.dumps(LAKE | {"discount": 0.9}))
    b.write_text(json.dumps(LAKE | PLANTED | {"step_size": 0.5}))

    def typed(*words, code=0):
        options = ["--recordings", str(tmp_path / "runs"), "--workers", "1", "--seeds", "2"]
        done = CliRunner().invoke(cli, ["explain", str(a), str(b), *options, *words])
        assert done.exit_code == code, done.stderr
        return done

    plan = json.loads(typed("--dry-run", "--json").stdout)
    assert (plan["mixtures"], plan["seeds"], plan["known"]) == (4, 2, 4)
    assert plan["seconds"] > 0
    assert json.loads(typed("--dry-run", "--json").stdout) == plan  # the time is known from before
    assert typed("--dry-run", "--markdown").stdout.startswith("## What would be trained\n\n- settings: 2\n")
    whole = typed()
    assert (
        "8 runs: 4 mixtures of 2 settings, 2 seeds each, 4 of them trained already; about 10 s"
        in whole.stderr
    )
    assert "epsilon alone makes 100 % of it" in whole.stdout
    found = json.loads(typed("--json").stdout)
    assert found["smallest"]["settings"] == ["epsilon"]
    assert sum(setting["share"]["value"] for setting in found["settings"]) == pytest.approx(100.0)
    assert typed("--markdown").stdout.startswith("## a (A) and b (B)")
    assert "nothing to train" in typed("--dry-run").stdout
    assert "expected one that evaluations of both have" in typed("--metric", "nothing", code=2).stderr


def test_ctrl_c_while_a_worker_starts_lets_it_start_first(tmp_path, monkeypatch):
    """Else the worker finds no pipe, and prints a traceback."""
    (tmp_path / "a.yaml").write_text(json.dumps(LAKE))
    (tmp_path / "b.yaml").write_text(json.dumps(LAKE | PLANTED))
    monkeypatch.chdir(tmp_path)
    started = []

    def start_process(*args, **keywords):
        signal.raise_signal(signal.SIGINT)
        started.append(workers_start(*args, **keywords))
        return started[-1]

    workers_start = workers.start_process
    monkeypatch.setattr(workers, "start_process", start_process)
    done = CliRunner().invoke(cli, ["explain", "a.yaml", "b.yaml", "--workers", "1"])
    assert (done.exit_code, len(started)) == (130, 1)
    assert "What was trained is kept" in done.stderr
    assert not started[0].is_alive()


def test_a_run_is_explained_by_its_configuration_and_seed(tmp_path):
    run = runner.run(LAKE | PLANTED, seed=7, recordings=tmp_path)
    found = explained(run, LAKE | PLANTED | {"step_size": 0.5}, tmp_path, seeds=2)
    assert (found.a.run_id, found.seeds) == (run.run_id, (7, 8))
    assert runner.find_run("@latest", tmp_path).run_id == run.run_id
    assert found.mixtures[0].values[0] == run.summary.last_evaluation.values["success_percent"]
    assert any("same seeds" in note for note in found.notes)
    assert "<svg" in found._repr_html_()
    assert "Share of each setting" in found._repr_html_()


def test_the_first_step_reports_its_progress_and_can_be_stopped(tmp_path):
    reports = []

    def stop():
        return any(what == EPISODES for _, _, what in reports)

    with pytest.raises(KeyboardInterrupt):
        explained(LAKE, LAKE | PLANTED, tmp_path, report=lambda *now: reports.append(now), stop=stop)
    assert {what for _, _, what in reports} == {RUNS, EPISODES}
    left = list_runs(tmp_path / UNLISTED)
    assert [run.status for run in left] == ["finished"][: len(left)]  # no half of a run stays
    found = explained(LAKE, LAKE | PLANTED, tmp_path)
    assert found.trained == 0
    assert len(list_runs(tmp_path / UNLISTED)) == 2


def test_prune_removes_what_was_trained_but_what_is_kept(tmp_path):
    found = explained(LAKE, LAKE | PLANTED, tmp_path, seeds=2)
    kept, other = list_runs(tmp_path / UNLISTED)
    label(kept, tag=["keep"])

    def command(*words):
        return CliRunner().invoke(cli, [*words, "--recordings", str(tmp_path)])

    listed = json.loads(command("du", "--json").stdout)["freeable"]["explanations"]
    assert listed > other.recording.stat().st_size
    shown = command("prune", "--explanations", "--dry-run")
    assert "Nothing was removed" in shown.stderr
    assert other.recording.is_file()
    assert command("prune", "--explanations").exit_code == 2  # nobody to ask
    assert command("prune", "--explanations", 'status == "failed"', "--yes").exit_code == 2
    removed = command("prune", "--explanations", "--yes")
    assert removed.exit_code == 0, removed.output
    assert f"Run {kept.run_id} stays" in removed.stderr
    assert explanations_in(tmp_path) == []
    assert [run.run_id for run in list_runs(tmp_path / UNLISTED)] == [kept.run_id]
    assert not (tmp_path / ".explain" / found.name.split("/")[0]).exists()


def test_a_script_without_a_guard_is_not_run_by_the_processes_that_train(tmp_path):
    script = (
        "from pathlib import Path\n"
        "import runner\n"
        "with Path('begun').open('a') as file:\n"
        "    file.write('.')\n"
        f"runner.explain({LAKE!r}, {LAKE | PLANTED!r}, seeds=2, recordings='runs')\n"
    )
    (tmp_path / "script.py").write_text(script)
    words = [sys.executable, "script.py"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "begun").read_text() == "."
