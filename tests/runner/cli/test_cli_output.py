"""Printed results: numbers, tables that fit the terminal, drawings."""

import json

import pytest
from click.testing import CliRunner
from rich.console import Console

from runner.analysis.evaluations import EvaluationRecord, TrainingRecord, evaluations_grid, spread
from runner.analysis.sections import Grid
from runner.cli import cli, output
from runner.config import from_mapping
from runner.drawing.text import TextDrawing, signs
from runner.execution.estimate import estimate, step_limit
from runner.util import humanize
from runner.util.row_text import json_lines


@pytest.mark.parametrize(
    ("count", "words"),
    [
        *[
            (0, "0 B"),
            (999, "999 B"),
            (1000, "1.0 kB"),
            (9_940, "9.9 kB"),
            (9_960, "10 kB"),
            (99_700, "100 kB"),
        ],
        *[
            (999_600, "1.0 MB"),
            (7_600_000, "7.6 MB"),
            (2.1e9, "2.1 GB"),
            (3.2e13, "32 TB"),
            (1e16, "10,000 TB"),
        ],
    ],
)
def test_size(count, words):
    assert humanize.size(count) == words


@pytest.mark.parametrize(
    ("count", "words"),
    [(0, "0"), (9_999, "9,999"), (12_345, "12 thousand"), (1_940_000, "1.9 million"), (2e9, "2.0 billion")],
)
def test_amount(count, words):
    assert humanize.amount(count) == words


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(-1, "0.0 s"), (0.83, "0.8 s"), (59.4, "59 s"), (125, "2 min 5 s"), (4320, "1 h 12 min"), (3e5, "3 d")],
)
def test_duration(seconds, words):
    assert humanize.duration(seconds) == words


@pytest.mark.parametrize(
    ("seconds", "words"), [(-3, "0 s"), (59, "59 s"), (61, "1 min"), (7300, "2 h"), (1e6, "11 d")]
)
def test_age(seconds, words):
    assert humanize.age(seconds) == words


def test_unknown_numbers_are_a_dash():
    assert [humanize.number(value) for value in (None, float("nan"), 98.54)] == ["–", "–", "98.5"]
    assert humanize.number(1234.5, 0) == "1,234"


def test_json_has_no_nan(capsys):
    value = {"a": float("nan"), "b": [1.5, float("inf")], 3: (True, None, "x")}
    (line,) = json_lines([value])
    assert line == '{"a": null, "b": [1.5, null], "3": [true, null, "x"]}\n'
    output.print_replies(output.Reply(value), "json")
    assert json.loads(capsys.readouterr().out) == json.loads(line)


NAMES = [
    f"taxi_{i}.{event}" for event in ("pickup", "drop_off", "wrong_stop", "illegal_pickup") for i in (1, 2)
]


def _record(events, episode=50_000, success=98.5, filled=(77.8, 78.1)):
    filled = {f"taxi_{i}": percent for i, percent in enumerate(filled, 1)}
    training = TrainingRecord(episode, 10**6, 16.0, (), {"percent_filled": filled}, 0.1, 0.5, 0.9)
    values = {
        "success_percent": {"": success},
        "mean_length": {"": 1500.0},
        "mean_penalties": {"": 1499.9},
        "mean_return": dict.fromkeys(filled, -800.0),
    }
    return EvaluationRecord(0, episode, 10 * episode, 200, None, values, 0, events, training)


def _lines(records, success, width):
    console = Console(width=width)
    with console.capture() as captured:
        console.print(output.grid_table(evaluations_grid(records, success), width))
    return captured.get().splitlines()


@pytest.mark.parametrize("width", [60, 80, 100, 200])
def test_the_table_of_evaluations_fits(width):
    names = [*NAMES, "taxi_1.illegal_drop_off", "taxi_2.illegal_drop_off", "collision"]
    events = dict.fromkeys(names, 23_456)
    lines = _lines([_record(events)], ["taxi_1.drop_off", "taxi_2.drop_off"], width)
    assert all(len(line) <= width for line in lines)
    assert not any("…" in line for line in lines)
    text = "\n".join(lines)
    assert "50,000" in text
    assert "78/78" in text
    assert ("No room for: pickup" in text) == (width <= 80)


def test_wrapped_cells_are_aligned_with_their_row():
    grid = Grid(("in\nepisode", "about"), [("7", "a text that takes several lines")])
    console = Console(width=20)
    with console.capture() as captured:
        console.print(output.grid_table(grid, 20))
    lines = [line.split() for line in captured.get().splitlines()]
    assert lines[:2] == [["in"], ["episode", "about"]]
    assert lines[2][:2] == ["7", "a"]
    assert lines[-1] == ["lines"]


def test_successes_are_per_agent_and_other_events_summed():
    events = dict.fromkeys(NAMES, 4) | {"taxi_1.drop_off": 12, "taxi_2.drop_off": 9, "collision": 3}
    *_, line = _lines([_record(events)], ["taxi_1.drop_off", "taxi_2.drop_off"], 200)
    assert line.split() == ["50,000", "98.5", "1,500.0", "1,499.9", "12/9", "3", "8", "8", "8", "78/78"]


def test_an_environment_without_events():
    record = _record({}, success=None, filled=(12.34,))
    *_, line = _lines([record], [], 80)
    assert line.split() == ["50,000", "–", "1,500.0", "1,499.9", "12.3"]


def test_many_evaluations_are_thinned_evenly():
    records = [_record({}, episode) for episode in range(0, 51_000, 1000)]
    shown = [record.episode for record in spread(records)]
    assert (len(shown), shown[0], shown[-1]) == (20, 0, 50_000)
    assert shown == sorted(set(shown))
    assert spread(records[:20]) == records[:20]


SCENE = {
    "rows": 2,
    "columns": 3,
    "walls": [[[0, 0], [0, 1]], [[0, 2], [1, 2]]],
    "landmarks": [{"name": "R", "cell": [0, 0], "colour": "#D55E00"}],
    "things": [
        {"name": "taxi_1", "label": "taxi 1", "kind": "mover", "agent": "taxi_1"},
        {"name": "walker", "label": "walker", "kind": "mover", "agent": "walker"},
        {"name": "passenger", "label": "passenger", "kind": "passenger"},
        {"name": "destination", "label": "destination", "kind": "goal"},
    ],
    "actions": [],
}


def test_a_drawing_needs_no_colours():
    drawing = TextDrawing(SCENE)
    assert drawing.draw([1, 5, 1, 0], [-1, -1, 0, -1]).plain.splitlines() == [
        "+-----+-----+-----+",
        "|R   *| 1 P       |",
        "+     +     +-----+",
        "|             W   |".replace("W   |", " W  |")[:19],
        "+-----+-----+-----+",
    ]
    assert drawing.legend.startswith("1 taxi 1   W walker   p passenger   * destination")
    assert signs(SCENE["things"]) == ["1", "W", "p", "*"]


def test_the_estimate_is_bounded_and_grows_with_what_is_recorded():
    config = from_mapping({"episodes": 1000, "evaluation": {"every": 300, "trials": 10}})
    made = estimate(config, 100)
    assert made.max_steps == (1000 + 5 * 10) * 100  # evaluations after 0, 300, 600, 900 and 1000
    assert made.typical_steps == (500 + 5 * 10) * 50 + 500 * 10
    assert made.max_bytes == made.max_steps * 33
    bare = from_mapping({"episodes": 1000, "recording": {"index": "chunk"}})
    none = from_mapping({"episodes": 1000, "recording": {"steps": "none"}})
    assert estimate(none, 100).typical_bytes < estimate(bare, 100).typical_bytes < made.typical_bytes * 10
    random = from_mapping({"episodes": 1000, "algorithm": "random", "evaluation": None})
    assert estimate(random, 100).typical_steps == 1000 * 50


@pytest.mark.parametrize(
    ("env", "limit"),
    [
        ({}, 1500),
        ({"kwargs": {"max_episode_steps": 7}}, 7),
        ({"id": "CliffWalking-v1"}, 0),
        ({"id": "Nothing-v1"}, None),
        ({"id": "nowhere:Nothing-v1"}, None),
    ],
)
def test_the_step_limit_is_the_registrations(env, limit):
    assert step_limit(from_mapping({"episodes": 1, "env": env})) == limit


@pytest.mark.parametrize("words", [("diff", "a", "b"), ("compare", "a", "b"), ("sweep", "show", "a")])
def test_json_and_markdown_at_once_are_refused(words):
    result = CliRunner().invoke(cli, [*words, "--json", "--markdown"])
    assert result.exit_code == 2
    assert "choose one" in result.stderr
