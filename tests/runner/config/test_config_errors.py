"""Errors: one line for each problem, with place, key, and what was expected."""

from typing import get_args

import pytest

from runner.config import from_mapping
from runner.config.sections import Algorithm
from runner.errors import ConfigError

ALGORITHMS = get_args(Algorithm)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("epsilon: 1.5", "2:1: epsilon: found 1.5, expected a number from 0 to 1"),
        ("epsilon: -0.1", "2:1: epsilon: found -0.1, expected a number from 0 to 1"),
        ("epsilon: .nan", "2:1: epsilon: found .nan, expected a number from 0 to 1"),
        ("epsilon: true", "2:1: epsilon: found true, expected a number from 0 to 1"),
        (
            "epsilon: high",
            "2:1: epsilon: found 'high', expected a number from 0 to 1 or a mapping with schedule: linear, "
            "exponential or piecewise",
        ),
        ("epsilonn: 0.5", "2:1: epsilonn: unknown key. Did you mean 'epsilon'?"),
        ("log: {evry_steps: 5}", "2:7: log.evry_steps: unknown key. Did you mean 'every_steps'?"),
        ("gamma: 0.5", "2:1: gamma: unknown key. Did you mean 'discount'?"),
        ("n_step_q_learning: {n: 2}", "2:1: n_step_q_learning: unknown key. Did you mean 'n_step'?"),
        ("learning_rate: 0.5", "2:1: learning_rate: unknown key. Did you mean 'step_size'?"),
        (
            "epsilon: {schedule: exponential, start: 1, decay: 0.9}",
            "2:44: epsilon.decay: unknown key. Did you mean 'factor'?",
        ),
        ("snapshots: {x: 5}", "2:13: snapshots.x: unknown key. Known: every"),
        ("step_size: 0", "2:1: step_size: found 0, expected a number above 0 and at most 1"),
        ("step_size: .inf", "2:1: step_size: found .inf, expected a number above 0 and at most 1"),
        (
            "step_size: {schedule: linear, start: 1, end: 0, over: 5}",
            "2:1: step_size: found a schedule that reaches 0, expected values above 0: set its floor",
        ),
        (
            "epsilon:\n  schedule: linaer\n  start: 1\n",
            "3:3: epsilon.schedule: found 'linaer', expected 'linear', 'exponential' or 'piecewise'. "
            "Did you mean 'linear'?",
        ),
        (
            "epsilon: {start: 1}",
            "2:1: epsilon.schedule: missing, expected 'linear', 'exponential' or 'piecewise'",
        ),
        (
            "epsilon:\n  schedule: exponential\n  start: 1\n  factor: 1.1\n",
            "5:3: epsilon.factor: found 1.1, expected a number above 0 and at most 1",
        ),
        (
            "epsilon: {schedule: linear, start: 1, end: 2, over: 9}",
            "2:39: epsilon.end: found 2, expected a number from 0 to 1",
        ),
        (
            "epsilon: {schedule: linear, start: 1, ende: 0, over: 9}",
            "2:39: epsilon.ende: unknown key. Did you mean 'end'?",
        ),
        (
            "epsilon: {schedule: piecewise, points: [[1, 1.0]]}",
            "2:42: epsilon.points[0][0]: found 1, expected 0: the first point's position",
        ),
        (
            "epsilon:\n  schedule: piecewise\n  points:\n  - [0, 1.0]\n  - [9, 0.5]\n  - [9, 0.1]\n",
            "7:6: epsilon.points[2][0]: found 9, expected a position after the one before, 9",
        ),
        (
            "epsilon: {schedule: piecewise, points: [[0, 1.0], [9]]}",
            "2:51: epsilon.points[1]: found a list of 1, expected [a whole number from 0 to 10^12, "
            "a number from 0 to 1]",
        ),
        ("mode: coop", "2:1: mode: found 'coop', expected 'cooperative' or 'competitive'"),
        (
            "mode: cooperativ",
            "2:1: mode: found 'cooperativ', expected 'cooperative' or 'competitive'. "
            "Did you mean 'cooperative'?",
        ),
        ("mode:", "2:1: mode: found null, expected 'cooperative' or 'competitive'"),
        (
            "mode: cooperative\nrewards: individual",
            "3:1: rewards: found 'individual', but mode: cooperative means tables: joint and rewards: team. "
            "Remove `mode`, or this key",
        ),
        (
            "tables: joint\nrewards: individual",
            "3:1: rewards: found 'individual', expected 'team': "
            "one joint table cannot learn from two rewards",
        ),
        (
            "quirks: {second_table_uses_first_action: true}",
            "2:10: quirks.second_table_uses_first_action: needs tables: per_agent (or mode: competitive), "
            "found tables: joint",
        ),
        ("quirks: {epsilon_exploits: 1}", "2:10: quirks.epsilon_exploits: found 1, expected true or false"),
        (
            "quirks: {epsilon_exploits: yes}",
            "2:10: quirks.epsilon_exploits: found 'yes', expected true or false",
        ),
        ("seed: -1", "2:1: seed: found -1, expected a whole number from 0 to 2^64 - 1"),
        (
            "seed: 18446744073709551616",
            "2:1: seed: found 18446744073709551616, expected a whole number from 0 to 2^64 - 1",
        ),
        ("seed: 1\nseeds: [1]", "3:1: seeds: given together with `seed`, expected one of them"),
        ("seeds: [1, 2, 1]", "2:15: seeds[2]: found 1 for the second time, expected each seed once"),
        ("seeds: [1, 2.0]", "2:12: seeds[1]: found 2.0, expected a whole number from 0 to 2^64 - 1"),
        (
            "seeds: []",
            "2:1: seeds: found an empty list, expected a list [a whole number from 0 to 2^64 - 1, ...]",
        ),
        (
            "seeds: 5",
            "2:1: seeds: found 5, expected a list [a whole number from 0 to 2^64 - 1, ...] or a mapping with "
            "first, count",
        ),
        ("seeds: {count: 0}", "2:9: seeds.count: found 0, expected a whole number from 1 to 100,000"),
        (
            "evaluation: {every: 10}",
            "2:1: evaluation.trials: missing, expected a whole number from 1 to 1,000,000",
        ),
        (
            "evaluation: {every: 10, trials: 0}",
            "2:25: evaluation.trials: found 0, expected a whole number from 1 to 1,000,000",
        ),
        ("log: 5", "2:1: log: found 5, expected null or a mapping with every_steps, window, episodes"),
        (
            "recording: {level: 20}",
            "2:13: recording.level: found 20, expected a whole number from -7 to 19 or null",
        ),
        (
            "recording: {compression: lz4, level: 3}",
            "2:31: recording.level: found 3, but compression is lz4: only zstd has levels. Remove it",
        ),
        (
            "recording: {chunk_steps: 100}",
            "2:13: recording.chunk_steps: found 100, expected a whole number from 256 to 65,536",
        ),
        (
            "env: {kwargs: {competitive: true}}",
            "2:16: env.kwargs.competitive: is never set by hand: it follows from `mode` (or `rewards`). "
            "Remove it and set `mode`",
        ),
        ("env: {id: ''}", "2:7: env.id: found '', expected text, not empty"),
        ("env: DualTaxi-v1", "2:1: env: found 'DualTaxi-v1', expected a mapping with id, kwargs"),
        (
            "initial_q: zero",
            "2:1: initial_q: found 'zero', expected 'random', a number, a mapping with random "
            "or a mapping with run, step",
        ),
        ("initial_q: {rum: a}", "2:13: initial_q.rum: unknown key. Did you mean 'run'?"),
        (
            "initial_q: {random: {low: 1, high: 0}}",
            "2:30: initial_q.random.high: found 0, expected a number above low, 1",
        ),
        (
            "name: a/b",
            "2:1: name: found 'a/b', expected 1 to 100 letters, digits, '_', '.' or '-', "
            "not starting with '.' or '-'",
        ),
        ("snapshots:", "2:1: snapshots: found null, expected a mapping with every"),
        (
            "algorithm: q_lerning",
            f"2:1: algorithm: found 'q_lerning', expected {', '.join(map(repr, ALGORITHMS[:-1]))} "
            f"or {ALGORITHMS[-1]!r}. Did you mean 'q_learning'?",
        ),
        ("episodes: 5", "2:1: episodes: given twice; first in line 1"),
        ("log: {window: 5, window: 6}", "2:18: log.window: given twice; first in line 2"),
        ("env: {kwargs: {1: 2}}", "2:16: env.kwargs: found the key 1, expected text: quote it"),
        (
            "epsilon: !!python/name:os.system a",
            "2:1: epsilon: found the tag !!python/name:os.system, expected a plain value without a tag",
        ),
        ("epsilon: !!float high", "2:1: epsilon: found high, which is no number"),
        ("evaluation: !!null never", "2:1: evaluation: found never, which is no null"),
        ("evaluation: !!bool never", "2:1: evaluation: found never, which is no true or false"),
        ("epsilon: !<%0A> 1", "2:1: epsilon: found the tag '\\n', expected a plain value without a tag"),
        ("<<: {seed: 1}", "2:1: found the merge key <<, expected the keys themselves"),
        ('"a: b\\n": 1', "2:1: 'a: b\\n': unknown key."),
    ],
)
def test_each_problem_has_one_line_with_place_and_expectation(errors_of, text, line):
    lines = errors_of(f"episodes: 1\n{text}\n")
    assert len(lines) == 1
    assert lines[0].startswith(f"x.yaml:{line}")
    assert lines[0] == f"x.yaml:{line}" or line.endswith("unknown key.")


@pytest.mark.parametrize(
    "value", ["'12'", "12.0", "true", "-3", "null", "[1]", "{a: 1}", "10000000000000", "1_000"]
)
def test_episodes_must_be_a_whole_number(errors_of, value):
    (line,) = errors_of(f"episodes: {value}")
    assert line.startswith("x.yaml:1:1: episodes: found ")
    assert line.endswith(", expected a whole number from 0 to 10^12")


def test_every_problem_is_listed_in_the_order_of_the_file(errors_of):
    lines = errors_of(
        "# a comment\nepsilon: 2\n\nseed: x\nmode: competitive\ntables: joint\n"
        "log:\n  window: 0\nunheard_of: 1\n",
    )
    assert [line.split(": ")[0].removeprefix("x.yaml:") for line in lines] == [
        "2:1",
        "2:1",
        "4:1",
        "6:1",
        "8:3",
        "9:1",
    ]
    assert [line.split(": ")[1] for line in lines] == [
        "episodes",
        "epsilon",
        "seed",
        "tables",
        "log.window",
        "unheard_of",
    ]


def test_a_misspelt_key_is_not_reported_as_missing_too(errors_of):
    assert errors_of("episode: 5") == ["x.yaml:1:1: episode: unknown key. Did you mean 'episodes'?"]


@pytest.mark.parametrize(
    ("override", "line"),
    [
        ("epsilon=1.5", "epsilon=1.5: epsilon: found 1.5, expected a number from 0 to 1"),
        ("epsilonn=1", "epsilonn=1: epsilonn: unknown key. Did you mean 'epsilon'?"),
        (
            "log.window=0",
            "log.window=0: log.window: found 0, expected a whole number from 1 to 100,000,000",
        ),
        (
            "epsilon.schedule=linear",
            "epsilon.schedule=linear: epsilon.end: missing, expected a number from 0 to 1",
        ),
        (
            "seeds=[1, a]",
            "seeds=[1, a]: seeds[1]: found 'a', expected a whole number from 0 to 2^64 - 1",
        ),
        ("epsilon", "epsilon: expected KEY=VALUE, such as epsilon=0.2 or evaluation.trials=50"),
        ("=1", "=1: expected KEY=VALUE, such as epsilon=0.2 or evaluation.trials=50"),
        ("a..b=1", "a..b=1: expected KEY=VALUE, such as epsilon=0.2 or evaluation.trials=50"),
        (
            "epsilon=[1",
            "epsilon=[1: cannot be read as YAML: expected ',' or ']', but got '<stream end>'",
        ),
        ("epsilon={a: 1, a: 2}", "epsilon={a: 1, a: 2}: epsilon.a: given twice"),
        ("epsilon=\n2", "'epsilon=\\n2': epsilon: found 2, expected a number from 0 to 1"),
        ("epsilon=\0", "'epsilon=\\x00': cannot be read as YAML: the character U+0000"),
        ("a." * 60 + "b=1", "expected a key of at most 50 parts"),
    ],
)
def test_errors_name_the_override(errors_of, override, line):
    assert any(found.endswith(line) for found in errors_of("episodes: 1\nepsilon: 0.5", [override]))


def test_an_override_that_contradicts_the_file_is_refused(errors_of):
    assert errors_of("episodes: 1\nmode: cooperative", ["tables=per_agent"]) == [
        "tables=per_agent: tables: found 'per_agent', but mode: cooperative means tables: joint "
        "and rewards: team. Remove `mode`, or this key"
    ]
    assert len(errors_of("episodes: 1", ["seed=1", "seeds=[2]"])) == 1
    assert errors_of("episodes: 1\nseed: 1\nseed: 2", ["seed=3"]) == [
        "x.yaml:3:1: seed: given twice; first in line 2"
    ]


def test_python_values_are_checked_like_files():
    for values, line in [
        ({}, "episodes: missing, expected a whole number from 0 to 10^12"),
        ({"episodes": 1, 2: 3}, "2: unknown key, which is not even text"),
        ({"episodes": "1"}, "episodes: found '1', expected"),
        (
            {"episodes": 1, "epsilon": object()},
            "epsilon: found a Python object, expected a number from 0 to 1 or",
        ),
        ({"episodes": 1, "env": {"kwargs": {"a": {1, 2}}}}, "env.kwargs.a: found a Python set, expected"),
        (
            {"episodes": 1, "env": {"kwargs": {"a": float("nan")}}},
            "env.kwargs.a: found a number that is not finite",
        ),
        (
            {"episodes": 1, "env": {"kwargs": {"a": 2**64}}},
            "env.kwargs.a: found a whole number of more than 64 bits",
        ),
        (
            {"episodes": 1, "env": {"kwargs": {"a": "\ud800"}}},
            "env.kwargs.a: found '\\ud800', expected text that",
        ),
        ({"episodes": 10**5000}, "episodes: found a whole number of 16610 bits, expected"),
    ]:
        with pytest.raises(ConfigError) as caught:
            from_mapping(values)
        assert str(caught.value).startswith(line)
    with pytest.raises(ConfigError, match="found a list of 1, expected keys and values"):
        from_mapping([1])


def test_values_that_contain_themselves_are_refused():
    endless: dict = {}
    endless["a"] = endless
    with pytest.raises(ConfigError, match="nested deeper than 50 levels"):
        from_mapping({"episodes": 1, "env": {"kwargs": endless}})
    with pytest.raises(ConfigError, match="epsilon"):
        from_mapping({"episodes": 1, "epsilon": endless})


def test_the_list_of_problems_is_bounded(errors_of):
    lines = errors_of("episodes: 1\nseeds: [" + "x, " * 1000 + "]")
    assert len(lines) == 201
    assert lines[-1] == "... and 800 more"


@pytest.mark.parametrize("value", ["foo", "-1", "1.5", "[1]", "true", "{a: 1}"])
def test_an_invalid_start_of_trials_is_refused(errors_of, value):
    (line,) = errors_of(f"episodes: 1\nevaluation: {{every: 1, trials: 1, start: {value}}}")
    assert line.endswith("expected 'random', 'each', or a state's number from 0")


def test_a_wrong_value_on_which_a_default_depends_is_reported(errors_of):
    assert errors_of("episodes: 1\nrecording: {compression: brotli}") == [
        "x.yaml:2:13: recording.compression: found 'brotli', expected 'zstd', 'lz4' or 'none'"
    ]
