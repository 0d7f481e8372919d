"""Groups of runs are compared by statistics that can be done by hand, and nothing is left out silently."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

import runner
from runner.analysis.compare import compare
from runner.analysis.compare.moments import Moment
from runner.analysis.compare.sections import sections, summary
from runner.analysis.groups import grouped, groups_of, metrics_of, panels_of
from runner.analysis.sections import markdown
from runner.analysis.series import RunSeries
from runner.errors import RunnerError

FINISH = [("success_percent", "")]


def run(seed, curve, *, name="a", finished=True, metric="success_percent", line="", **config):
    """Return a run whose metric takes the values of a curve, every 100 episodes."""
    evaluation = [(100 * k, {metric: {line: float(value)}}) for k, value in enumerate(curve)]
    config = {"episodes": 100 * (len(curve) - 1), "name": name} | config
    if "made_by" not in config:
        config = {"seeds": [seed]} | config
    status = "finished" if finished else "interrupted"
    environment = config.get("env", {}).get("id", "")
    run_id = f"{name}{seed}{'' if finished else 'x'}"
    return RunSeries(run_id, name, seed, status, config, evaluation, [], environment=environment)


def two_groups(left, right, **kwargs):
    """Return runs of two groups, whose last values are these, seeds from 0."""
    series = [run(seed, [0, value], discount=0.8, **kwargs) for seed, value in enumerate(left)]
    return series + [run(s, [0, value], name="b", discount=0.9, **kwargs) for s, value in enumerate(right)]


def result(series, moment=None, metrics=FINISH, by=None):
    groups, notes = grouped(series, by)
    return compare(groups, metrics, moment or Moment("last"), notes)


def test_median_iqm_and_wins_are_those_done_by_hand():
    (metric,) = result(two_groups([10, 20, 30, 90], [11, 10, 30, 40])).metrics
    a, b = metric.groups
    assert (a.n, a.median, a.iqm.value) == (4, 25, 25)
    assert (b.median, b.iqm.value) == (20.5, 20.5)
    (pair,) = metric.pairs
    assert (pair.wins, pair.ties, pair.losses) == (2, 1, 1)
    assert (pair.median, pair.iqm.value) == (5, 5)  # of -1, 10, 0, 50
    pairs = [(x > y) + (x == y) / 2 for x in (10, 20, 30, 90) for y in (11, 10, 30, 40)]
    assert pair.improvement.value == pytest.approx(np.mean(pairs))


def test_lower_is_better_where_it_is():
    series = two_groups([10, 10, 10, 10], [50, 60, 70, 80], metric="mean_length")
    (metric,) = result(series, metrics=[("mean_length", "")]).metrics
    (pair,) = metric.pairs
    assert (pair.wins, pair.losses, pair.improvement.value) == (4, 0, 1)
    assert metric.thresholds[0] == 80
    assert metric.groups[0].profile[-1] == 1
    assert metric.groups[1].profile[-1] == 0


def test_intervals_hold_what_they_are_of_and_are_the_same_again():
    rng = np.random.default_rng(7)
    series = two_groups(rng.normal(60, 5, 12), rng.normal(50, 5, 12))
    first, second = (result(series).metrics[0] for _ in range(2))
    assert first == second
    for estimate in (first.groups[0].iqm, first.pairs[0].iqm, first.pairs[0].improvement):
        assert estimate.low < estimate.value < estimate.high or estimate.high == 1
    assert first.pairs[0].iqm.low > 0


def test_too_few_seeds_have_no_simultaneous_intervals():
    rng = np.random.default_rng(5)
    series = [
        run(seed, [0, value], name=name, discount=discount)
        for name, discount in (("a", 0.8), ("b", 0.9), ("c", 0.7))
        for seed, value in enumerate(rng.normal(0, 1, 5))
    ]
    few = result(series)
    assert all(math.isnan(pair.simultaneous.low) for pair in few.metrics[0].pairs)
    assert text_of(few).count("too few seeds") == 3


def test_intervals_that_hold_together_are_shown_where_there_are_several():
    alone = result(two_groups(range(10), range(5, 15)))
    assert math.isnan(alone.metrics[0].pairs[0].simultaneous.low)
    assert "together" not in text_of(alone).split("How to read")[0]
    rng = np.random.default_rng(5)
    series = [
        run(seed, [0, value], name=name, discount=discount)
        for name, discount in (("a", 0.8), ("b", 0.9), ("c", 0.7))
        for seed, value in enumerate(rng.normal(0, 1, 10))
    ]
    several = result(series)
    for pair in several.metrics[0].pairs:
        assert pair.simultaneous.value == pair.iqm.value
        width = pair.simultaneous.high - pair.simultaneous.low
        assert width > pair.iqm.high - pair.iqm.low
    assert "together" in text_of(several).split("How to read")[0]


def test_workers_of_one_training_are_one_value_of_their_seed():
    def workers(values, **config):
        made = [loop(0, [value], **config) for value in values]
        return [replace(one, run_id=f"w{i}{config}", content_digest=f"d{i}") for i, one in enumerate(made)]

    compared = result([*workers([1, 5], lr=1), *workers([2, 3, 4], lr=2)], metrics=[("mean_return", "")])
    (metric,) = compared.metrics
    assert [group.values for group in metric.groups] == [[3.0], [3.0]]
    assert [len(group.run_ids) for group in metric.groups] == [2, 3]
    assert "2 runs of 1 seeds, each seed with the mean of its runs" in metric.notes[0]
    assert "are equal at all 1 seeds" in summary(compared)[0]


def test_identical_groups_are_reported_as_identical():
    def digested(runs):
        return [replace(one, content_digest=f"content{one.seed}") for one in runs]

    same = result(digested(two_groups([10, 20, 30], [10, 20, 30])))
    assert "are identical: their runs have the same content, seed by seed" in same.notes[0]
    assert "a and b are equal at all 3 seeds" in summary(same)[0]


def test_equal_values_have_an_interval_of_no_width():
    (metric,) = result(two_groups([100] * 6, [100] * 6)).metrics
    assert (metric.groups[0].iqm.low, metric.groups[0].iqm.high) == (100, 100)
    assert metric.pairs[0].improvement.value == 0.5
    assert metric.thresholds == [100]


def test_seeds_that_only_one_has_are_left_out_of_the_pair_and_named():
    comparison = result(two_groups([10, 20, 30, 40, 50, 60], [10, 20, 30, 40]))
    (pair,) = comparison.metrics[0].pairs
    assert (pair.seeds, pair.left_out_a, pair.left_out_b) == ([0, 1, 2, 3], [4, 5], [])
    assert "without seed 4, 5, which" in text_of(comparison)


def test_without_a_common_seed_there_is_no_difference():
    series = [run(0, [1, 2], discount=1), run(1, [1, 2], name="b")]
    (pair,) = result(series).metrics[0].pairs
    assert math.isnan(pair.median)
    assert pair.seeds == []


def test_few_seeds_are_warned_of_and_have_no_iqm_below_four():
    comparison = result(two_groups([10, 20, 30], [10, 20, 30]))
    assert "fewer than 10 seeds" in comparison.notes[0]
    assert math.isnan(comparison.metrics[0].groups[0].iqm.value)
    assert "the setting `seeds: {count: 10}` runs ten" in comparison.notes[0]
    assert result(two_groups([1] * 10, [2] * 10)).notes == []
    of_loops = result(two_groups([10, 20], [10, 20], made_by="runner.record"))
    assert of_loops.notes[0].endswith("as a hint; record more, each with a seed of its own")


def test_other_environments_are_warned_of():
    lake, cliff = {"id": "FrozenLake-v1", "kwargs": {}}, {"id": "CliffWalking-v1", "kwargs": {}}
    others = [
        run(seed, [0, 1], name=name, env=env)
        for seed in range(10)
        for name, env in zip("ab", (lake, cliff), strict=True)
    ]
    (note,) = result(others).notes
    assert "FrozenLake-v1 in a, CliffWalking-v1 in b" in note
    assert result(two_groups([1] * 10, [2] * 10, env=lake)).notes == []


def test_runs_of_one_configuration_are_one_group_whatever_they_are_called():
    series = [run(0, [1, 2]), run(1, [1, 2], name="b"), run(2, [1, 2], discount=0.5)]
    groups, _ = grouped(series)
    assert [group.label for group in groups] == ["a / b", "a"]


def test_a_label_has_the_values_that_its_runs_have():
    schedule = {"start": 0.9, "over": 50}
    groups = groups_of([run(0, [1, 2], epsilon=0.1), run(1, [1, 2], epsilon=schedule)])
    assert [group.label for group in groups] == ["a, epsilon=0.1", "a, epsilon.over=50, epsilon.start=0.9"]


def test_a_run_done_twice_counts_once_and_is_reported():
    groups, notes = grouped([run(0, [1, 2], finished=False), run(0, [1, 2]), run(1, [1, 2])])
    assert [r.run_id for r in groups[0].runs] == ["a0", "a1"]
    assert "a0x" in notes[0]


def test_the_outcomes_of_many_pairs_are_left_to_the_table():
    series = [
        run(seed, [0, 50 + i], name=name, discount=i / 10)
        for i, name in enumerate("abcde")
        for seed in (0, 1)
    ]
    compared = result(series)
    *outcomes, more = summary(compared)
    assert len(outcomes) == 6
    assert more == "The table has 4 more pairs."


def test_grouping_by_a_value_of_the_configuration():
    series = [run(seed, [1, seed], schedule={"over": over}) for seed in (0, 1) for over in (5, 9)]
    groups, _ = grouped(series, "schedule.over")
    assert [(group.label, len(group.runs)) for group in groups] == [
        ("schedule.over = 5", 2),
        ("schedule.over = 9", 2),
    ]
    with pytest.raises(RunnerError, match=r"by: found 'schedule.ever'.*Did you mean 'schedule.over'"):
        grouped(series, "schedule.ever")


def test_moments_of_a_curve():
    series = [run(0, [0, 80, 40, 60], discount=d, name=n) for d, n in ((1, "a"), (0.5, "b"))]

    def value(moment):
        return result(series, moment).metrics[0].groups[0].median

    assert value(Moment("last")) == 60
    assert value(Moment("best")) == 80
    assert value(Moment("position", 200)) == 40
    assert value(Moment("area")) == pytest.approx((40 + 60 + 50) / 3)
    assert value(Moment("crossing", level=50.0)) == 100
    assert value(Moment("crossing", level=99.0)) == math.inf


@pytest.mark.parametrize(
    ("metric", "best"),
    [
        ("exact.success_percent", 80),
        ("exact.mean_length", 5),
        ("exact.value", 80),
        ("exact.to_gain", 5),
    ],
)
def test_the_best_of_an_exact_measure_is_on_its_better_side(metric, best):
    series = [run(0, [40, 80, 5, 60], metric=metric, discount=d, name=n) for d, n in ((1, "a"), (0.5, "b"))]
    assert result(series, Moment("best"), [(metric, "")]).metrics[0].groups[0].median == best


@pytest.mark.parametrize(("metric", "level"), [("success_percent", 30.0), ("mean_penalties", 50.0)])
def test_a_run_that_begins_on_the_better_side_of_a_level_is_there_at_once(metric, level):
    series = [run(0, [40, 20, 60], metric=metric, discount=d, name=n) for d, n in ((1, "a"), (0.5, "b"))]
    assert result(series, Moment("crossing", level=level), [(metric, "")]).metrics[0].groups[0].median == 0


def test_a_level_reached_by_some_is_ranked_after_all_numbers():
    series = [run(seed, [0, 10 * seed], discount=1) for seed in range(6)]
    series += [run(seed, [0, 100], name="b") for seed in range(6)]
    (metric,) = result(series, Moment("crossing", level=30.0)).metrics
    slow, fast = metric.groups
    assert (slow.median, fast.median) == (math.inf, 100)
    assert slow.values == [math.inf] * 3 + [100.0] * 3
    assert metric.pairs[0].losses == 3
    assert "never" in text_of(result(series, Moment("crossing", level=30.0)))


def test_a_level_that_no_run_reaches_is_never_reached():
    (metric,) = result(two_groups([1, 2], [3, 4]), Moment("crossing", level=99.0)).metrics
    assert [group.median for group in metric.groups] == [math.inf, math.inf]
    assert metric.thresholds == metric.groups[0].profile == []
    assert metric.pairs[0].ties == 2


def test_interrupted_runs_are_left_out_and_taken_at_an_episode_that_they_have():
    series = [*two_groups([1, 2, 3, 4], [1, 2, 3, 4]), run(9, [0, 77], finished=False, discount=0.8)]
    metric = result(series).metrics[0]
    assert metric.groups[0].seeds == [0, 1, 2, 3]
    assert "a9x (not finished" in metric.notes[0]
    assert result(series, Moment("position", 100)).metrics[0].groups[0].seeds == [0, 1, 2, 3, 9]


def test_groups_of_other_lengths_and_modes_are_compared_as_far_as_they_can_be():
    series = [run(0, [0, 10]), run(0, [0, 10, 20], name="b")]
    assert "the moment 100 compares" in result(series).metrics[0].notes[0]
    series = [run(0, [0, 1], metric="mean_return", line=line, mode=line) for line in ("agency", "taxi_1")]
    groups, _ = grouped(series)
    metrics = metrics_of(groups)
    assert metrics == [("mean_return", "agency"), ("mean_return", "taxi_1")]
    first = compare(groups, metrics, Moment("last")).metrics[0]
    assert len(first.groups) == 1
    assert "has no mean_return.agency" in first.notes[0]


def test_an_unknown_metric_is_refused_with_those_there_are():
    groups, _ = grouped(two_groups([1], [2]))
    with pytest.raises(RunnerError, match="Did you mean 'success_percent'"):
        metrics_of(groups, ["success_percentage"])


def text_of(comparison):
    return "\n".join(markdown(sections(comparison)))


TINY = {
    "mode": "competitive",
    "env": {"kwargs": {"max_episode_steps": 40}},
    "episodes": 20,
    "evaluation": {"every": 10, "trials": 5},
    "recording": {"steps": "none"},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("compared")
    for name, discount in (("near", 0.5), ("far", 0.95)):
        config = TINY | {"name": name, "discount": discount, "seeds": [0, 1, 2]}
        list(runner.run_all(config, recordings=made))
    return made


@pytest.fixture
def command(folder):
    from click.testing import CliRunner

    from runner.cli import cli

    return lambda *words: CliRunner().invoke(cli, ["compare", *words, "--recordings", str(folder)])


def test_the_command_prints_text_json_and_markdown(command):
    result = command("near", "far")
    assert result.exit_code == 0, result.output
    assert "near - far" in result.stdout
    assert "fewer than 10 seeds" in result.stdout
    as_json = json.loads(command("near", "far", "--json", "--metric", "mean_return").stdout)
    assert [metric["line"] for metric in as_json["metrics"]] == ["taxi_1", "taxi_2"]
    assert as_json["metrics"][0]["groups"][0]["seeds"] == [0, 1, 2]
    assert command("near", "far", "--markdown").stdout.startswith("## Groups")
    filtered = json.loads(command('seed < 2 and name in ("near", "far")', "--json").stdout)
    assert [group["seeds"] for group in filtered["metrics"][0]["groups"]] == [[0, 1], [0, 1]]
    by_value = command("near", "far", "--by", "discount", "--moment", "10")
    assert "discount = 0.95" in by_value.stdout


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["near"], "found 3 runs of one configuration"),
        (["near@latest"], "found one run"),
        (["near", "far", "--moment", "middle"], "expected last, best, area"),
        (["near", "far", "--moment", "9" * 400], "expected last, best, area"),
        (["near", "far", "--target", "success_percent=nan"], "expected METRIC=LEVEL"),
        (["near", "far", "--target", "success_percent"], "expected METRIC=LEVEL"),
        (["near", "far", "--target", "finish=80"], "expected one of"),
        (["near", "far", "--moment", "14"], "the nearest are those after 10 and 20"),
        (["near", "far", "--by", "tables"], "expected two values"),
        (["near", "nobody"], "nobody"),
        (["seed > 7"], "matches seed > 7"),
        (["name = 'near'"], "equality is =="),
    ],
)
def test_what_cannot_be_compared_is_reported_with_exit_code_2(command, words, expected):
    refused = command(*words)
    assert refused.exit_code == 2
    assert expected in refused.stderr
    assert "Traceback" not in refused.output


def loop(seed, curve, *, every=100, name="a", metric="mean_return", training=False, **config):
    """Return a loop whose metric takes the values of a curve, one every `every` episodes."""
    made = run(seed, [], name=name, made_by="runner.record", **config)
    points = [(every * k, {metric: {"": float(value)}}) for k, value in enumerate(curve, 1)]
    return replace(made, **{"training" if training else "evaluation": points})


def test_a_longer_episode_is_not_worse_in_a_loop_whose_environment_has_no_goal():
    runs = [loop(0, [9, 400], lr=0.1), loop(0, [9, 300], lr=0.2)]
    both = [
        replace(
            one,
            evaluation=[
                (at, {**result, "mean_length": result["mean_return"]}) for at, result in one.evaluation
            ],
        )
        for one in runs
    ]
    groups, _ = grouped(both)
    compared = compare(groups, metrics_of(groups), Moment("last"))
    better = {metric.metric: metric.higher_is_better for metric in compared.metrics}
    assert better == {"mean_return": True, "mean_length": None}
    assert "a, lr=0.1 is better than a, lr=0.2 at 1 of 1 seeds" in summary(compared)[0]


def test_loops_without_evaluation_are_compared_by_their_training():
    made = [loop(0, [1, value], metric="training.mean_return", training=True, lr=value) for value in (2, 5)]
    groups, _ = grouped(made)
    compared = compare(groups, metrics_of(groups), Moment("last"))
    (metric,) = compared.metrics
    assert (metric.metric, metric.higher_is_better) == ("training.mean_return", True)
    assert [group.values for group in metric.groups] == [[2.0], [5.0]]
    assert any(note.startswith("training is compared") for note in compared.notes)


def test_a_moment_is_advised_only_if_all_runs_have_it():
    groups, _ = grouped([loop(0, [1, 2], every=70, lr=1), loop(0, [1, 2], every=80, lr=2)])
    notes = compare(groups, metrics_of(groups), Moment("last")).metrics[0].notes
    after = "after 140 training episodes in a, lr=1, after 160 training episodes in a, lr=2"
    assert notes == [f"the last evaluation is {after}"]


def test_a_line_does_not_jump_between_runs_that_evaluated_at_other_moments():
    (group,) = groups_of([loop(1, [0, 0, 0], every=10), loop(2, [100, 100, 100], every=11)])
    (panel,) = panels_of([group])
    (curve,) = panel.curves
    assert curve.places.tolist() == [10, 11, 20, 22, 30, 33]
    assert curve.middle.tolist() == [0, 50, 50, 50, 50, 100]


def test_a_legend_shows_how_a_run_ended():
    failed = replace(run(0, [1, 2]), status="failed")
    assert "a0 seed 0, failed" in groups_of([failed])[0].described
