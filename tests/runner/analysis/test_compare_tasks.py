"""Algorithms are compared over environments by normalised scores that can be done by hand."""

from __future__ import annotations

import json
import math

import gymnasium
import numpy as np
import pytest
from click.testing import CliRunner

import runner
from runner.analysis import statistics
from runner.analysis.axes import STEPS
from runner.analysis.compare.moments import Moment
from runner.analysis.compare.sections import task_sections
from runner.analysis.compare.tasks import Bounds, compare_tasks, metric_of_tasks, parse_table, read_table
from runner.analysis.groups import grouped
from runner.analysis.sections import markdown
from runner.analysis.series import RunSeries
from runner.cli import cli
from runner.errors import RunnerError

TABLE = {"Cart": Bounds(0, 100), "Lake": Bounds(-10, 10), "Hill": Bounds(200, 100)}


def run(algorithm, task, seed, value, *, curve=(0,), status="finished"):
    """Return a loop of an algorithm in an environment, whose last return is the value."""
    points = [(10 * k, {"mean_return": {"": float(each)}}) for k, each in enumerate((*curve, value), 1)]
    config = {
        "made_by": "runner.record",
        "env": {"id": f"module:{task}", "kwargs": {}},
        "config": {"algorithm": algorithm, "env_id": task, "nested": {"again": task}},
    }
    run_id = f"{algorithm}{task}{seed}"
    return RunSeries(run_id, algorithm, seed, status, config, points, [], run_id, environment=task)


def runs_of(values):
    """Return runs of algorithm -> environment -> values, seeds from 0."""
    return [
        run(algorithm, task, seed, value)
        for algorithm, tasks in values.items()
        for task, own in tasks.items()
        for seed, value in enumerate(own)
    ]


def compared(series, table=TABLE, moment=None, by=None):
    groups, notes = grouped(series, by, across_tasks=True)
    return compare_tasks(groups, metric_of_tasks(groups, ()), moment or Moment("last"), table, notes)


RNG = np.random.default_rng(8)
VALUES = {
    "a": {"Cart": RNG.normal(70, 20, 6), "Lake": RNG.normal(3, 4, 6), "Hill": RNG.normal(130, 20, 6)},
    "b": {"Cart": RNG.normal(40, 20, 6), "Lake": RNG.normal(1, 4, 6), "Hill": RNG.normal(160, 20, 6)},
}


def test_aggregates_are_those_done_by_hand():
    from scipy.stats import trim_mean  # here, as it takes a second of every worker that collects the tests

    result = compared(runs_of(VALUES))
    for own in result.algorithms:
        scores = np.array(
            [
                (values - TABLE[task].zero) / (TABLE[task].one - TABLE[task].zero)
                for task, values in VALUES[own.label].items()
            ]
        )
        assert own.iqm.value == pytest.approx(trim_mean(scores.ravel(), 0.25))
        assert own.median.value == pytest.approx(np.median(scores.mean(axis=1)))
        assert own.mean.value == pytest.approx(scores.mean())
        assert own.optimality_gap.value == pytest.approx(1 - np.minimum(scores, 1).mean())
        for estimate in (own.iqm, own.median, own.mean, own.optimality_gap):
            assert estimate.low < estimate.value < estimate.high
        shares = [(scores >= threshold).mean() for threshold in result.thresholds]
        assert own.profile == pytest.approx(shares)
        assert (np.array(own.profile_low) <= shares).all()
        assert (np.array(own.profile_high) >= shares).all()
    (pair,) = result.improvements
    by_task = [
        np.mean([(x > y) + (x == y) / 2 for x in VALUES["a"][task] for y in VALUES["b"][task]])
        for task in ("Cart", "Lake")
    ]
    by_task.append(np.mean([x < y for x in VALUES["a"]["Hill"] for y in VALUES["b"]["Hill"]]))
    assert pair.probability.value == pytest.approx(np.mean(by_task))
    assert pair.probability.low < pair.probability.value < pair.probability.high <= 1


def test_the_interval_of_the_iqm_has_its_nominal_coverage():
    rng = np.random.default_rng(1)
    inside = 0
    for _ in range(40):
        strata = [rng.normal(0, 1, (10, 1)) for _ in range(3)]
        _, (low,), (high,) = statistics.stratified(strata, lambda own: statistics.iqm(np.concatenate(own), 0))
        inside += low <= 0 <= high
    assert inside >= 33


def test_worst_and_best_normalise_each_environment():
    result = compared(
        runs_of({"a": {"Cart": [10, 30], "Lake": [5, 5]}, "b": {"Cart": [20, 50], "Lake": [1, 3]}}), None
    )
    assert result.tasks == {"Cart": Bounds(10, 50), "Lake": Bounds(1, 5)}
    assert [own.scores["Cart"] for own in result.algorithms] == [[0, 0.5], [0.25, 1]]


def test_curves_are_the_iqm_at_positions_that_all_runs_cover():
    series = [
        run(algorithm, task, seed, 100.0, curve=[0.0, 50.0][: 2 if seed else 1])
        for algorithm in "ab"
        for task in ("Cart", "Lake")
        for seed in range(4)
    ]
    result = compared(series, {"Cart": Bounds(0, 100), "Lake": Bounds(0, 100)})
    assert (result.positions[0], result.positions[-1]) == (10, 20)
    assert result.algorithms[0].curve[0] == 0
    assert result.algorithms[0].curve[-1] == pytest.approx(0.5)  # of two runs at 100 and six at 50
    assert all(
        low <= middle <= high
        for low, middle, high in zip(
            result.algorithms[0].curve_low,
            result.algorithms[0].curve,
            result.algorithms[0].curve_high,
            strict=True,
        )
    )


def test_environments_that_not_all_have_are_left_out_and_named():
    values = {"a": {"Cart": [10, 20], "Lake": [1, 2]}, "b": {"Cart": [30, 40], "Hill": [110, 120]}}
    result = compared(runs_of(values))
    assert list(result.tasks) == ["Cart"]
    assert any("not every group has a value there: Lake, Hill" in note for note in result.notes)
    with pytest.raises(RunnerError, match=r"in which every group has a value \(a: Lake; b: Hill\)"):
        compared(runs_of({"a": {"Lake": [1, 2]}, "b": {"Hill": [110, 120]}}))


def test_one_seed_has_no_interval_and_few_are_reported():
    result = compared(runs_of({"a": {"Cart": [10], "Lake": [5]}, "b": {"Cart": [20, 50], "Lake": [1]}}))
    first, second = result.algorithms
    assert math.isnan(first.iqm.low)
    assert math.isnan(first.profile_low[0])
    assert second.iqm.low < second.iqm.high
    notes = " ".join(result.notes)
    assert "a has one seed in each environment: it has no interval" in notes
    assert "b has one seed in some environments" in notes
    assert "more seeds weigh more" in notes
    assert "–" in "\n".join(markdown(task_sections(result)))


def test_values_that_are_not_finite_and_runs_that_did_not_end_are_left_out():
    series = runs_of({"a": {"Cart": [10, 20, math.inf]}, "b": {"Cart": [30, 40, math.nan]}})
    series.append(run("a", "Cart", 7, 1000, status="interrupted"))
    result = compared(series)
    assert [own.seeds for own in result.algorithms] == [{"Cart": 3}, {"Cart": 3}]  # their values before count
    assert all(math.isfinite(score) for own in result.algorithms for score in own.scores["Cart"])
    assert any("aCart7" in note and "not finished" in note for note in result.notes)


def test_groups_are_by_configuration_without_environment_or_by_a_path():
    assert [own.label for own in compared(runs_of(VALUES)).algorithms] == ["a", "b"]
    named = compared(runs_of(VALUES), by="config.algorithm")
    assert [own.label for own in named.algorithms] == ['config.algorithm = "a"', 'config.algorithm = "b"']


@pytest.mark.parametrize(
    ("table", "expected"),
    [
        ({"Cart": Bounds(0, 1)}, "the table has no row for Lake, Hill; it has Cart"),
        (None, r"one value in every run, in Cart \(5\)"),
    ],
)
def test_what_cannot_be_normalised_is_refused(table, expected):
    values = VALUES if table else {"a": {"Cart": [5, 5]}, "b": {"Cart": [5]}}
    with pytest.raises(RunnerError, match=expected):
        compared(runs_of(values), table)


def test_a_level_cannot_be_normalised():
    with pytest.raises(RunnerError, match="found a target as well"):
        compared(runs_of(VALUES), moment=Moment("crossing", level=5))


def test_tables_are_read_from_csv_yaml_and_json(tmp_path):
    texts = {
        "a.csv": "task,random,expert\nCart,1.5,500\n",
        "a.yaml": "Cart: {random: 1.5, expert: 500}\n",
        "a.json": '{"Cart": {"random": 1.5, "expert": 500}}',
    }
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
        assert read_table(tmp_path / name) == {"Cart": Bounds(1.5, 500)}


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("a.txt", "", "expected .csv, .yaml or .json"),
        ("a.csv", "", "found the columns none, expected task, random, expert"),
        ("a.csv", "task,low,high\nCart,1,2\n", "found the columns task, low, high"),
        ("a.csv", "task,random,expert\n", "found no row"),
        ("a.csv", "task,random,expert\nCart,1,\n", "Cart: found .* expected finite numbers"),
        ("a.csv", "task,random,expert\nCart,nan,2\n", "expected finite numbers"),
        ("a.csv", "task,random,expert\nCart,-1e308,1e308\n", "expected finite numbers"),
        ("a.csv", "task,random,expert\nCart,1,inf\n", "expected finite numbers"),
        ("a.csv", "task,random,expert\nCart,2,2\n", "found 2 as random and as expert"),
        ("a.csv", "task,random,expert\nCart,1,2\nCart,1,3\n", "found a second row"),
        ("a.csv", "task,random,expert\nCart,1,2,3\n", "expected finite numbers"),
        ("a.yaml", "Cart: 5\n", "Cart: found 5, expected finite numbers"),
        ("a.yaml", "[1, 2]", "expected a mapping"),
        ("a.yaml", "{", "cannot be parsed"),
        ("a.json", "{", "cannot be parsed"),
        ("a.csv", f"task,random,expert\n{'x' * 140_000},1,2\n", "cannot be parsed"),
        ("a.json", f'{{"Cart": {{"random": 1, "expert": {10**400}}}}}', "expected finite numbers"),
    ],
)
def test_what_is_no_table_is_refused(name, text, expected):
    with pytest.raises(RunnerError, match=expected):
        parse_table(text, name)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two agents in two environments, three seeds each: one acts always alike, one at random."""
    made = tmp_path_factory.mktemp("tasks")
    for name in ("steady", "random"):
        for task in ("CartPole-v1", "MountainCar-v0"):
            for seed in range(3):
                env = runner.record(
                    gymnasium.make(task, max_episode_steps=30),
                    recordings=made,
                    name=name,
                    seed=seed,
                    config={"agent": name, "task": task},
                )
                env.action_space.seed(seed)
                env.reset(seed=seed)
                for _ in range(200):
                    *_, terminated, truncated, _ = env.step(
                        env.action_space.sample() if name == "random" else 0
                    )
                    if terminated or truncated:
                        env.reset()
                env.close()
    return made


def command(folder, *words):
    return CliRunner().invoke(cli, [*map(str, words), "--recordings", str(folder)])


def test_the_command_prints_text_and_json_and_writes_a_page_and_a_figure(folder, tmp_path):
    table = tmp_path / "scores.csv"
    table.write_text("task,random,expert\nCartPole-v1,9,30\nMountainCar-v0,-30,-20\n")
    words = ("steady", "random", "--normalise", table, "--axis", "steps")
    text = command(folder, "compare", *words)
    assert text.exit_code == 0, text.output
    assert "over 2 environments" in text.stdout
    found = json.loads(command(folder, "compare", *words, "--json").stdout)
    assert found["axis"] == STEPS.title
    assert found["tasks"]["CartPole-v1"] == {"zero": 9.0, "one": 30.0}
    assert [own["label"] for own in found["algorithms"]] == ["steady", "random"]
    assert found["algorithms"][0]["seeds"] == {"CartPole-v1": 3, "MountainCar-v0": 3}
    page = tmp_path / "page.html"
    assert command(folder, "compare", *words, "--html", page).exit_code == 0
    assert page.read_text().count("<svg") == 3
    figure = tmp_path / "figure.svg"
    drawn = command(folder, "plot", "steady", "random", "--normalise", table, "-o", figure)
    assert drawn.exit_code == 0, drawn.output
    assert "Normalised scores over 2 environments" in figure.read_text()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--normalise", "nothing.csv"], "nothing.csv: cannot be read"),
        (["--normalise", "minmax", "--target", "training.mean_return=3"], "found a target as well"),
        (["--normalise", "minmax", "--metric", "nothing"], "metric: found 'nothing'"),
        (
            ["--normalise", "minmax", "--metric", "training.mean_return", "--metric", "training.mean_length"],
            "expected one, as environments",
        ),
    ],
)
def test_what_the_command_cannot_normalise_is_reported(folder, words, expected):
    refused = command(folder, "compare", "steady", "random", *words)
    assert refused.exit_code == 2
    assert expected in refused.stderr
    assert "Traceback" not in refused.output


def test_training_is_compared_by_the_mean_of_the_last_100_episodes(tmp_path):
    returns = {}
    for name, episodes in (("short", 12), ("long", 130)):
        for env_id in ("CartPole-v1", "FrozenLake-v1"):
            config = {"algorithm": name, "env_id": env_id}
            with runner.record(
                gymnasium.make(env_id), tmp_path / "r", name=name, seed=0, config=config
            ) as env:
                own = returns[name, env_id] = []
                for k in range(episodes):
                    env.reset(seed=k)
                    total, done = 0.0, False
                    while not done:  # to the left: FrozenLake never pays
                        _, reward, terminated, truncated, _ = env.step(
                            0 if "Lake" in env_id or k % 3 else k % 2
                        )
                        total, done = total + reward, terminated or truncated
                    own.append(total)
    mean = {name: np.mean(returns[name, "CartPole-v1"][-100:]) for name in ("short", "long")}

    def compared_as(*options):
        words = ["compare", "short", "long", "--recordings", str(tmp_path / "r"), *options]
        found = CliRunner().invoke(cli, words)
        assert found.exit_code == 0, found.output
        return found.stdout

    plain = json.loads(compared_as("--json"))
    values = {group["label"]: group["values"][0] for group in plain["metrics"][0]["groups"]}
    assert sorted(values.values()) == pytest.approx(sorted([0, 0, *mean.values()]))
    assert not any("env_id" in label for label in values)
    assert any("normalised, by `minmax`" in note for note in plain["notes"])
    text = compared_as("--normalise", "minmax")
    assert "the mean over the last 12 to 100 episodes of training" in text
    assert "last evaluation" not in text
    assert "every run has the same value there, so minmax has no scale: FrozenLake-v1" in text
    assert "fewer than 10 seeds in short (1), long (1)" in text
    assert "CartPole-v1: the last report of training is after 12 training episodes in short" in text
    bounds = json.loads(compared_as("--normalise", "minmax", "--json"))["tasks"]["CartPole-v1"]
    assert sorted(bounds.values()) == pytest.approx(sorted(mean.values()))


class Balance(gymnasium.Env):
    """Ends when the action is 0, and never otherwise."""

    observation_space = gymnasium.spaces.Discrete(2)
    action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return 0, {}

    def step(self, action):
        return 0, 1.0, action == 0, False, {}


def test_an_algorithm_that_never_ends_an_episode_keeps_its_environment(tmp_path):
    for algorithm, period in (("good", 1000), ("bad", 10)):
        for seed in range(2):
            config = {"algorithm": algorithm}
            with runner.record(Balance(), tmp_path, name=algorithm, seed=seed, config=config) as env:
                env.reset(seed=seed)
                for step in range(1, 101):
                    if env.step(int(step % period > 0))[2]:
                        env.reset()
    arguments = ["compare", "good", "bad", "--normalise", "minmax", "--recordings", str(tmp_path), "--json"]
    result = CliRunner().invoke(cli, arguments)
    assert result.exit_code == 0, result.output
    reply = json.loads(result.stdout)
    scores = {own["label"]: own["scores"] for own in reply["algorithms"]}
    assert [list(own.values()) for own in scores.values()] == [[[1.0, 1.0]], [[0.0, 0.0]]]
    assert any("no episode ended in" in note for note in reply["notes"])
