"""Filters: what they let through, compared with a plain Python reading of the same question; and refusals."""

from __future__ import annotations

import fnmatch
import json
import math
from datetime import UTC, datetime, timedelta

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from runner.errors import RunnerError
from runner.runs.catalogue.filters import MAX_DEPTH, MAX_LENGTH, parse, size_of
from runner.runs.catalogue.index import look

NOW = datetime(2026, 6, 15, 12, tzinfo=UTC)
RUNS = [
    {
        "run_id": f"{'ab'[i % 2]}{'cde'[i % 3]}{i:02}",
        "name": ["quick", "Quick_2", "slow", "über", "a b"][i % 5],
        "seed": [0, 1, 2, 2**63, 2**64 - 1][i % 5],
        "status": ["finished", "interrupted", "failed"][i % 3],
        "created": (NOW - timedelta(days=i, hours=i)).isoformat(),
        "config": {
            "name": ["quick", "slow"][i % 2],
            "discount": [0.9, 0.95, 1, {"start": 0.5}][i % 4],
            "evaluation": {"every": i},
            "flag": bool(i % 2),
            "algorithm": ["q_learning", "7"][i % 2],
        },
        "summary": {}
        if i % 4 == 3
        else {"episodes": 10 * i, "last_evaluation": {"success_percent": 12.5 * (i % 9)}},
        "labels": {"tags": [["keep"], ["keep", "fig-3"], []][i % 3], "note": ["", "Look\nhere"][i % 2]},
    }
    for i in range(24)
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("filtered")
    for run in RUNS:
        place = made / run["run_id"]
        place.mkdir()
        (place / "run.json").write_text(json.dumps({key: run[key] for key in run if key != "labels"}))
        (place / "labels.json").write_text(json.dumps(run["labels"]))
    return made


def found(folder, text):
    chosen = parse(text, NOW)
    rows = look([folder], lambda index: (index.select(chosen), index.count(chosen)))
    assert rows[1] == len(rows[0])
    return {row["id"] for row in rows[0]}


def outcome(folder, text):
    """Return what is found, or how the error begins."""
    try:
        return found(folder, text)
    except RunnerError as error:
        return str(error).partition(":")[0]


# --- the same question twice: as a filter, and as a function of a run ----------------------------------


def fits(value, pattern):
    lines = value.casefold().split("\n")
    return any(fnmatch.fnmatchcase(line, pattern.casefold()) for line in lines)


def compared(get, sign, bound):
    def test(run):
        value = get(run)
        if type(value) not in (int, float):
            return False
        return {
            "": value == bound,
            ">": value > bound,
            ">=": value >= bound,
            "<": value < bound,
            "<=": value <= bound,
        }[sign]

    return test


def words(run):
    labels = run["labels"]
    return [run["run_id"], run["name"], run["config"]["name"], *labels["tags"], labels["note"]]


signs = st.sampled_from(["", ">", ">=", "<", "<="])
percents = st.sampled_from([0, 12.5, 33.3, 50, 100])
patterns = st.sampled_from(
    ["quick", "QUICK", "q*", "*o*", "?low", "über", "ÜBER", "keep", "fig*", "zzz", "*"]
)


def number_leaf(name, get, bounds):
    return st.builds(lambda sign, bound: (f"{name}:{sign}{bound}", compared(get, sign, bound)), signs, bounds)


def text_leaf(name, get):
    return st.builds(lambda p: (f"{name}:{p}", lambda run: any(fits(v, p) and v for v in get(run))), patterns)


def day_leaf(sign, day):
    start = datetime(2026, 6, day, tzinfo=UTC)
    stop = start + timedelta(days=1)
    tests = {
        "": lambda at: start <= at < stop,
        ">": lambda at: at >= stop,
        ">=": lambda at: at >= start,
        "<": lambda at: at < start,
        "<=": lambda at: at < stop,
    }
    return f"created:{sign}2026-06-{day:02}", lambda run: tests[sign](datetime.fromisoformat(run["created"]))


def range_leaf(low, high, with_low, with_high):
    text = f"episodes:{'[' if with_low else '{'}{low} TO {high}{']' if with_high else '}'}"

    def test(run):
        value = run["summary"].get("episodes")
        above = value is not None and (value >= low if with_low else value > low)
        return above and (value <= high if with_high else value < high)

    return text, test


leaves = st.one_of(
    number_leaf("seed", lambda run: run["seed"], st.sampled_from([0, 1, 5, 2**63, 2**64 - 1])),
    number_leaf(
        "success_percent",
        lambda run: run["summary"].get("last_evaluation", {}).get("success_percent"),
        percents,
    ),
    number_leaf("config.discount", lambda run: run["config"]["discount"], st.sampled_from([0.9, 0.95, 1, 2])),
    number_leaf(
        "config.evaluation.every", lambda run: run["config"]["evaluation"]["every"], st.integers(0, 24)
    ),
    text_leaf("name", lambda run: [run["name"]]),
    text_leaf("config", lambda run: [run["config"]["name"]]),
    text_leaf("tag", lambda run: run["labels"]["tags"]),
    st.builds(lambda p: (p, lambda run: any(fits(v, f"*{p}*") for v in words(run))), patterns),
    st.builds(day_leaf, signs, st.integers(1, 20)),
    st.builds(range_leaf, st.integers(0, 200), st.integers(0, 200), st.booleans(), st.booleans()),
    st.sampled_from(
        [
            ("age:<5d", lambda run: NOW - datetime.fromisoformat(run["created"]) < timedelta(days=5)),
            ("age:>=36h", lambda run: NOW - datetime.fromisoformat(run["created"]) >= timedelta(hours=36)),
            ("id:a", lambda run: run["run_id"].startswith("a")),
            ("status:finished", lambda run: run["status"] == "finished"),
            ("note:HER", lambda run: "here" in run["labels"]["note"]),
            ("NOT tag:*", lambda run: not run["labels"]["tags"]),
            ("config.flag:true", lambda run: run["config"]["flag"]),
            ("config.algorithm:7", lambda run: run["config"]["algorithm"] == "7"),
            ('name:"a b"', lambda run: run["name"] == "a b"),
            ("name:a\\ b", lambda run: run["name"] == "a b"),
            ('name:"q*"', lambda _: False),
        ]
    ),
)


def joined(parts, how):
    texts, tests = zip(*parts, strict=True)
    combine = {" AND ": all, " ": all, " OR ": any}[how]
    return f"({how.join(texts)})", lambda run: combine(test(run) for test in tests)


filters = st.recursive(
    leaves,
    lambda inner: st.one_of(
        st.builds(joined, st.lists(inner, min_size=2, max_size=4), st.sampled_from([" AND ", " OR ", " "])),
        st.builds(lambda part: (f"(NOT {part[0]})", lambda run: not part[1](run)), inner),
    ),
    max_leaves=8,
)


@settings(max_examples=150, deadline=None)
@given(filters)
def test_a_filter_lets_through_what_plain_python_does(folder, question):
    text, test = question
    assert found(folder, text) == {run["run_id"] for run in RUNS if test(run)}


@pytest.mark.parametrize(
    "text",
    [
        "x' OR '1'='1",
        "name:'; DROP TABLE runs; --",
        'name:"\\" OR 1=1 --"',
        "name:*' UNION SELECT * FROM runs --",
        'config.a\\"]:1',
        "config.x') OR 1=1 --:1",
        "note:%",
        "name:__import__('os').system('true')",
        "tag:${HOME} `id` $(id)",
    ],
)
def test_nothing_of_a_filter_is_carried_out(folder, text):
    assert outcome(folder, text) in (set(), "filter")
    assert len(found(folder, "")) == len(RUNS)


@settings(max_examples=200, deadline=None)
@given(st.text(alphabet="abnoAND OR:*?\"\\()[]{}<>=-+!~^/TO1.%'\x00\né", max_size=40))
def test_any_text_is_a_filter_or_refused_with_its_place(folder, text):
    assert outcome(folder, text) == "filter" or found(folder, text) <= {run["run_id"] for run in RUNS}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sede:3", "Did you mean 'seed'?"),
        ("config.discuont:3", "Did you mean 'discount'?"),
        ("status:finishd", "Did you mean 'finished'?"),
        ("a AND", "ends where a value or a ')' is expected.\n  a AND\n       ^"),
        ("a b)", "unexpected ')'.\n  a b)\n     ^"),
        ('name:"a', "quote that is not closed"),
        ("a and b", "found 'and', expected AND"),
        ("seed>3", "expected seed:>3"),
        ("seed!=3", "expected NOT seed:3"),
        ("seed:x", "expected a whole number"),
        ("seed:>0.5", "expected a whole number"),
        ("episodes:>1_0", "expected a number"),
        ("episodes:nan", "expected a number"),
        ("created:>soon", "expected a date such as"),
        ("age:>3", "expected a time span such as"),
        ("age:3d", "with < or >"),
        ("bytes:>3XB", "10MB"),
        ("name:>b", "text has no order"),
        ("name:b~2", "expected a word"),
        ("name:(seed:3)", "after name:, expected a value"),
        ("config.x:>-1", "negative number is put in quotes"),
        (">3", "expected a field before it"),
        ("(" * (MAX_DEPTH + 1) + "a" + ")" * (MAX_DEPTH + 1), "nested"),
        ("a" * (MAX_LENGTH + 1), "characters"),
    ],
)
def test_refusals_say_what_was_meant(folder, text, message):
    with pytest.raises(RunnerError) as caught:
        found(folder, text)
    assert message in str(caught.value)


def test_a_filter_may_have_very_many_words(folder):
    assert found(folder, " OR ".join(f"id:{run['run_id']}" for run in RUNS * 15)) == {
        r["run_id"] for r in RUNS
    }


def test_a_pattern_of_many_stars_is_quick(folder):
    assert found(folder, "note:" + "*o" * 40 + "z") == set()


def test_sizes_and_negative_numbers(folder):
    assert [size_of(text) for text in ("3", "1.5 GB", "10mb", "2T")] == [3, 1.5e9, 1e7, 2e12]
    assert found(folder, 'config.evaluation.every:>"-1"') == {run["run_id"] for run in RUNS}
    assert found(folder, "success_percent:[-1 TO 1]") == {
        run["run_id"]
        for run in RUNS
        if run["summary"].get("last_evaluation", {"success_percent": math.nan})["success_percent"] <= 1
    }
