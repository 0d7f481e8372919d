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
from runner.runs.catalogue.filters import FilterParser, parse, size_of
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
            "items": [4, 5],
            **({"missing_or_null": None} if i % 2 else {}),
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
            return sign == "!="
        return {
            "==": value == bound,
            "!=": value != bound,
            ">": value > bound,
            ">=": value >= bound,
            "<": value < bound,
            "<=": value <= bound,
        }[sign]

    return test


def words(run):
    labels = run["labels"]
    return [run["run_id"], run["name"], run["config"]["name"], *labels["tags"], labels["note"]]


signs = st.sampled_from(["==", "!=", ">", ">=", "<", "<="])
percents = st.sampled_from([0, 12.5, 33.3, 50, 100])
plain = st.sampled_from(["quick", "QUICK", "slow", "über", "ÜBER", "keep", "fig-3", "zzz", "a b", "q*"])
patterns = st.sampled_from(
    ["quick", "QUICK", "q*", "*o*", "?low", "[qs]*", "über", "ÜBER", "keep", "fig*", "*"]
)


def number_leaf(name, get, bounds):
    return st.builds(
        lambda sign, bound: (f"{name} {sign} {bound}", compared(get, sign, bound)), signs, bounds
    )


def flipped_leaf(name, get, bounds):
    flip = {"<": ">", "<=": ">=", ">": "<", ">=": "<="}
    return st.builds(
        lambda sign, bound: (f"{bound} {sign} {name}", compared(get, flip.get(sign, sign), bound)),
        signs,
        bounds,
    )


def like_leaf(name, get):
    return st.builds(
        lambda p: (f'like({name}, "{p}")', lambda run: any(fits(v, p) and v for v in get(run))), patterns
    )


def equal_leaf(name, get):
    return st.builds(
        lambda text: (f'{name} == "{text}"', lambda run: text.casefold() in [v.casefold() for v in get(run)]),
        plain,
    )


def one_of_leaf(name, get):
    return st.builds(
        lambda texts: (
            f"{name} in ({', '.join(map(repr, texts))},)",
            lambda run: any(text.casefold() == v.casefold() for text in texts for v in get(run)),
        ),
        st.lists(plain, min_size=1, max_size=3),
    )


def part_leaf(name, get):
    return st.builds(
        lambda text: (
            f'"{text}" in {name}',
            lambda run: any(text.casefold() in v.casefold() for v in get(run)),
        ),
        plain,
    )


def day_leaf(sign, day):
    start = datetime(2026, 6, day, tzinfo=UTC)
    stop = start + timedelta(days=1)
    tests = {
        "==": lambda at: start <= at < stop,
        "!=": lambda at: not start <= at < stop,
        ">": lambda at: at >= stop,
        ">=": lambda at: at >= start,
        "<": lambda at: at < start,
        "<=": lambda at: at < stop,
    }
    return f'created {sign} "2026-06-{day:02}"', lambda run: tests[sign](
        datetime.fromisoformat(run["created"])
    )


def range_leaf(low, high, with_low, with_high):
    text = f"{low} {'<=' if with_low else '<'} episodes {'<=' if with_high else '<'} {high}"

    def test(run):
        value = run["summary"].get("episodes")
        above = value is not None and (value >= low if with_low else value > low)
        return above and (value <= high if with_high else value < high)

    return text, test


def words_leaf(text):
    return f'"{text}"', lambda run: any(text.casefold() in v.casefold() for v in words(run))


def episodes(run):
    return run["summary"].get("episodes")


def every(run):
    return run["config"]["evaluation"]["every"]


leaves = st.one_of(
    number_leaf("seed", lambda run: run["seed"], st.sampled_from([0, 1, 5, 2**63, 2**64 - 1])),
    number_leaf(
        "success_percent",
        lambda run: run["summary"].get("last_evaluation", {}).get("success_percent"),
        percents,
    ),
    flipped_leaf("seed", lambda run: run["seed"], st.sampled_from([0, 1, 5, 2**63, 2**64 - 1])),
    number_leaf("config.discount", lambda run: run["config"]["discount"], st.sampled_from([0.9, 0.95, 1, 2])),
    number_leaf(
        "config.evaluation.every", lambda run: run["config"]["evaluation"]["every"], st.integers(0, 24)
    ),
    like_leaf("name", lambda run: [run["name"]]),
    like_leaf("tags", lambda run: run["labels"]["tags"]),
    equal_leaf("config", lambda run: [run["config"]["name"]]),
    equal_leaf("tag", lambda run: run["labels"]["tags"]),
    one_of_leaf("name", lambda run: [run["name"]]),
    part_leaf("name", lambda run: [run["name"]]),
    part_leaf("note", lambda run: run["labels"]["note"].split("\n")),
    st.builds(words_leaf, plain),
    st.builds(day_leaf, signs, st.integers(1, 20)),
    st.builds(range_leaf, st.integers(0, 200), st.integers(0, 200), st.booleans(), st.booleans()),
    st.sampled_from(
        [
            ('age < "5d"', lambda run: NOW - datetime.fromisoformat(run["created"]) < timedelta(days=5)),
            ('"36h" <= age', lambda run: NOW - datetime.fromisoformat(run["created"]) >= timedelta(hours=36)),
            ("age < 432000", lambda run: NOW - datetime.fromisoformat(run["created"]) < timedelta(days=5)),
            ('like(id, "a*")', lambda run: run["run_id"].startswith("a")),
            ('status == "finished"', lambda run: run["status"] == "finished"),
            ('status in ["failed", "interrupted"]', lambda run: run["status"] in ("failed", "interrupted")),
            ('"HER" in note', lambda run: "here" in run["labels"]["note"]),
            ("tags is None", lambda run: not run["labels"]["tags"]),
            ("episodes is not None", lambda run: episodes(run) is not None),
            ('"keep" in tags', lambda run: "keep" in run["labels"]["tags"]),
            ('"kee" in tags', lambda _: False),
            ('"keep" not in tags', lambda run: "keep" not in run["labels"]["tags"]),
            ("config.flag == True", lambda run: run["config"]["flag"]),
            ("config.flag == False", lambda run: not run["config"]["flag"]),
            ("config.flag != True", lambda run: not run["config"]["flag"]),
            ("config.flag == 1", lambda _: False),
            ("config.missing_or_null is None", lambda _: True),
            ("config.missing_or_null == None", lambda run: run["config"].get("missing_or_null", 0) is None),
            ('config.algorithm == "7"', lambda run: run["config"]["algorithm"] == "7"),
            ("config.algorithm == 7", lambda _: False),
            ('"learn" in config.algorithm', lambda run: run["config"]["algorithm"] == "q_learning"),
            ('config["discount.start"] == 0.5', lambda run: run["config"]["discount"] == {"start": 0.5}),
            ('config["evaluation"].every >= 3', lambda run: every(run) >= 3),
            ("config.items[1] == 5", lambda _: True),
            ("-config.evaluation.every + 2 * 3 > 1 / 2", lambda run: -every(run) + 6 > 0.5),
            ("abs(config.evaluation.every - 10) <= max(1, 2, 3)", lambda run: abs(every(run) - 10) <= 3),
            (
                "episodes == 10 * config.evaluation.every",
                lambda run: episodes(run) is not None,
            ),
        ]
    ),
)


def joined(parts, how):
    texts, tests = zip(*parts, strict=True)
    combine = {" and ": all, " or ": any}[how]
    return f"({how.join(texts)})", lambda run: combine(test(run) for test in tests)


filters = st.recursive(
    leaves,
    lambda inner: st.one_of(
        st.builds(joined, st.lists(inner, min_size=2, max_size=4), st.sampled_from([" and ", " or "])),
        st.builds(lambda part: (f"(not {part[0]})", lambda run: not part[1](run)), inner),
    ),
    max_leaves=8,
)


@settings(max_examples=60, deadline=None)
@given(filters)
def test_a_filter_lets_through_what_plain_python_does(folder, question):
    text, test = question
    assert found(folder, text) == {run["run_id"] for run in RUNS if test(run)}


@pytest.mark.parametrize(
    ("text", "test"),
    [
        ("quick", lambda v: "quick" in v),
        ("QU*CK", lambda v: fits(v, "*qu*ck*")),
        ("?low", lambda v: fits(v, "*?low*")),
        ("über", lambda v: "über" in v),
        ("fig-3", lambda v: "fig-3" in v),
    ],
)
def test_words_are_searched_for(folder, text, test):
    assert found(folder, text) == {
        run["run_id"] for run in RUNS if any(map(test, map(str.casefold, words(run))))
    }


def test_all_of_several_words_are_searched_for(folder):
    assert found(folder, " quick\tkeep ") == found(folder, '"quick" and "keep"') < found(folder, "keep")


@pytest.mark.parametrize(("text", "wanted"), [("quick -red", 'not "red"'), ("+keep", '"keep"')])
def test_words_with_the_signs_of_lucene_are_refused_with_the_new_form(folder, text, wanted):
    with pytest.raises(RunnerError, match=f"expected {wanted}\n"):
        found(folder, text)


@pytest.mark.parametrize(
    "text",
    [
        "x' OR '1'='1",
        'name == "\'; DROP TABLE runs; --"',
        'name == "\\" OR 1=1 --"',
        'like(name, "*\' UNION SELECT * FROM runs --")',
        "config['a\\\"]'] == 1",
        'config["x\') OR 1=1 --"] == 1',
        '"%" in note',
        "__import__('os').system('true')",
        "name.__class__.__mro__ == 1",
        "(lambda: 1)() == seed",
        '"{0.__class__}" in tags',
        '"${HOME} `id` $(id)" in tags',
    ],
)
def test_nothing_of_a_filter_is_carried_out(folder, text):
    assert outcome(folder, text) in (set(), "filter")
    assert len(found(folder, "")) == len(RUNS)


PIECES = r"""
    and or not in is None True ( ) [ ] , == != < <= > >= + - * / // % ** & | ~ : = . ! lambda {} \\ # x:y é
    "quick" 'q*' "12h" "5MB" "2026-06-01" 3 -1 1e999 99999999999999999999 0x1f 1j max( min( abs( like(
    name tags seed age created bytes status episodes config config.discount config["flag"] seed:3
"""


@settings(max_examples=100, deadline=None)
@given(st.lists(st.sampled_from(PIECES.split()), max_size=12).map(" ".join) | st.text(max_size=30))
def test_any_text_is_a_filter_or_refused_with_its_place(folder, text):
    assert outcome(folder, text) == "filter" or found(folder, text) <= {run["run_id"] for run in RUNS}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sede == 3", "Did you mean 'seed'?"),
        (
            "seed == 3 and config.discuont == 3",
            "Did you mean 'discount'?\n  seed == 3 and config.discuont == 3\n                ^^^^^^^^^^^^^^^",
        ),
        ("config[1+1] == 3", "config.KEY[0].\n  config[1+1] == 3\n         ^^^"),
        ("config[seed] == 3", "found seed, expected a field"),
        ("config[0:1] == 3", "found 0:1, expected a field"),
        ("in winter", 'put words to search for in quotes: "in winter"'),
        ('status == "finishd"', "Did you mean 'finished'?"),
        ('name == "a" and', "invalid syntax"),
        ("seed == 3)", "unmatched ')'\n  seed == 3)\n           ^"),
        ('name == "a', "unterminated string"),
        ("a AND b", "write `and`"),
        ("seed = 3", "equality is =="),
        ("episodes > 3 & seed == 3", "write `and`"),
        ("patient and red", "A text is put in quotes"),
        ("lake in winter", "put words to search for in quotes"),
        ("O'Brien", "put words to search for in quotes"),
        ("name == quick", "found quick, expected a text in quotes"),
        ('seed == "x"', "expected a whole number"),
        ("seed > 0.5", "expected a whole number from 0 to 18446744073709551615"),
        ("seed == -1", "expected a whole number"),
        ("seed == 18446744073709551616", "expected a whole number"),
        ("seed + 1 > 3", "found seed, expected a number"),
        ('episodes > "1"', "expected a number"),
        ("episodes > 1e999", "too large"),
        ('created > "soon"', "expected a date such as"),
        ("created > 2026-10-31", "expected a date such as"),
        ("created > 2026-01-31", "put in quotes"),
        ("age > 3d", "put in quotes"),
        ('age > "3"', "expected a time span such as"),
        ('age == "3d"', "with < or >"),
        ('bytes > "3XB"', "10MB"),
        ('name > "b"', "text has no order"),
        ("not name", "found name, expected a condition"),
        ("episodes and seed == 3", "found a number, expected a condition"),
        ('name.startswith("a")', "found a call"),
        ('liek(name, "a")', "Did you mean 'like'?"),
        ('like(seed, "a")', "found seed, expected a field of text"),
        ("like(name, 3)", "expected like() of a field and a text"),
        ("3 in tags", 'as in "keep" in tags'),
        ("seed in ()", "expected"),
        ("name is 3", "FIELD is None"),
        ("1 < 2", "expected a field in it"),
        ("episodes ** 9 > 3", "found episodes ** 9, expected comparisons"),
        ("episodes > 1\x00", "expected one such as"),
        ("\udcff", "expected one such as"),
        ("-" * 30 + "episodes > 3", "nested too deeply"),
        ("(" * 300 + "episodes" + ")" * 300, ""),
        ("not " * 900 + "episodes > 3", "nested too deeply"),
        ("-" * 9000 + "episodes > 3", "nested too deeply"),
        ("a" * (FilterParser.max_length + 1), "characters"),
    ],
)
def test_refusals_say_what_was_meant(folder, text, message):
    with pytest.raises(RunnerError) as caught:
        found(folder, text)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("seed:3", "seed == 3"),
        ("steps:>=1e6", "steps >= 1e6"),
        ("name:quick", 'name == "quick"'),
        ('name:"a b"', 'name == "a b"'),
        ("name:q* seed:3", 'like(name, "q*")'),
        ("id:ab", 'like(id, "ab*")'),
        ("a (tag:keep OR b)", '"keep" in tag'),
        ("NOT note:here", '"here" in note'),
        ("tag:*", "tag is not None"),
        ("age:<12h", 'age < "12h"'),
        ("bytes:>1.5GB", 'bytes > "1.5GB"'),
        ("created:2026-01-31", 'created == "2026-01-31"'),
        ("created:[2026-01-01 TO *]", "LOW <= created <= HIGH"),
        ("config.flag:true", "config.flag == True"),
        ("config.evaluation.every:200", "config.evaluation.every == 200"),
        ("status:", 'status == "VALUE"'),
    ],
)
def test_the_old_form_shows_the_new(folder, old, new):
    with pytest.raises(RunnerError, match=r"filter: found .*, expected ") as caught:
        found(folder, old)
    assert str(caught.value).split("\n")[0].endswith(f", expected {new}")
    if "VALUE" not in new and "LOW" not in new:
        found(folder, new)


def test_a_filter_may_have_very_many_words(folder):
    ids = [run["run_id"] for run in RUNS]
    assert found(folder, " or ".join(f'id == "{name}"' for name in ids * 15)) == set(ids)
    assert found(folder, f"id in {ids * 30}") == set(ids)


@pytest.mark.parametrize(
    "text",
    [
        "not " * 14 + "episodes > 3",
        "episodes > " + "max(1, " * 15 + "2" + ")" * 15,
        "episodes > " + "1 / (" * 14 + "2" + ")" * 14,
        "(episodes > 3 and (seed == 3 or " * 6 + "seed == 1" + "))" * 6,
    ],
)
def test_a_filter_as_deep_as_it_may_be_reaches_sql(folder, text):
    assert found(folder, text) <= {run["run_id"] for run in RUNS}


def test_a_pattern_of_many_stars_is_quick(folder):
    assert found(folder, "like(note, '" + "*o" * 40 + "z')") == set()


def test_sizes_and_negative_numbers(folder):
    assert [size_of(text) for text in ("3", "1.5 GB", "10mb", "2T")] == [3, 1.5e9, 1e7, 2e12]
    assert found(folder, "config.evaluation.every > -1") == {run["run_id"] for run in RUNS}
    assert found(folder, "-1 <= success_percent <= 1") == {
        run["run_id"]
        for run in RUNS
        if run["summary"].get("last_evaluation", {"success_percent": math.nan})["success_percent"] <= 1
    }
