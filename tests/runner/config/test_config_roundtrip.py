"""Round trips of configurations through mappings and YAML, and their agreement with the JSON Schema."""

import json

from hypothesis import given
from hypothesis import strategies as st
from jsonschema import Draft202012Validator

from runner.config import from_mapping, json_schema, load


def numbers(low, high, **kwargs):
    return st.floats(low, high, **kwargs) | st.sampled_from([n for n in (0, 1) if low <= n <= high])


def schedules(fraction):
    floor = {"by": st.sampled_from(["episode", "step"]), "floor": fraction}
    positions = st.lists(st.integers(1, 10**12), max_size=4, unique=True).map(
        lambda after: [0, *sorted(after)]
    )
    points = positions.flatmap(
        lambda ns: st.tuples(*(st.tuples(st.just(n), fraction).map(list) for n in ns)).map(list)
    )
    return st.one_of(
        st.fixed_dictionaries(
            {
                "schedule": st.just("linear"),
                "start": fraction,
                "end": fraction,
                "over": st.integers(1, 10**12),
            },
            optional=floor,
        ),
        st.fixed_dictionaries(
            {"schedule": st.just("exponential"), "start": fraction, "factor": numbers(1e-9, 1)},
            optional=floor,
        ),
        st.fixed_dictionaries({"schedule": st.just("piecewise"), "points": points}, optional=floor),
    )


FRACTION = numbers(0, 1)
POSITIVE = numbers(1e-9, 1)
COUNT = st.integers(1, 10**12)
TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=12) | st.sampled_from(
    [
        "1e-3",
        "no",
        "null",
        "~",
        "0x10",
        "2026-11-01",
        "1_000",
        "12:30",
        " a",
        "a: b",
        "<<",
        "-",
        "",
        "\x85",
        "é",
    ]
)
VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats(allow_nan=False, allow_infinity=False)
    | TEXT,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXT, inner, max_size=3),
    max_leaves=8,
)
RECORDING = {
    "steps": st.sampled_from(["all", "none"]),
    "index": st.sampled_from(["message", "chunk"]),
    "chunk_steps": st.integers(256, 65_536),
}
LEARNERS = st.sampled_from(
    [
        {},
        {"mode": "cooperative"},
        {"mode": "competitive"},
        {"tables": "per_agent", "rewards": "team"},
        {"rewards": "individual"},
    ]
)
SEEDS = st.one_of(
    st.just({}),
    st.integers(0, 2**64 - 1).map(lambda seed: {"seed": seed}),
    st.lists(st.integers(0, 2**64 - 1), min_size=1, max_size=5, unique=True).map(
        lambda seeds: {"seeds": seeds}
    ),
    st.builds(
        lambda first, count: {"seeds": {"first": first, "count": count}},
        st.integers(0, 99),
        st.integers(1, 9),
    ),
)
QUIRKS = st.fixed_dictionaries(
    {}, optional={"epsilon_exploits": st.booleans(), "bootstrap_after_termination": st.booleans()}
)
REST = st.fixed_dictionaries(
    {"episodes": COUNT},
    optional={
        "name": st.from_regex(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}", fullmatch=True),
        "env": st.fixed_dictionaries(
            {},
            optional={
                "id": TEXT.filter(bool),
                "kwargs": st.dictionaries(TEXT.filter(lambda key: key != "competitive"), VALUES, max_size=4),
            },
        ),
        "algorithm": st.sampled_from(["q_learning", "random"]),
        "step_size": POSITIVE | schedules(POSITIVE),
        "discount": FRACTION | schedules(FRACTION),
        "epsilon": FRACTION | schedules(FRACTION),
        "exploration": st.sampled_from(["shared", "independent"]),
        "initial_q": st.one_of(
            st.floats(allow_nan=False, allow_infinity=False),
            st.integers(-(10**6), 10**6),
            st.just("random"),
            st.fixed_dictionaries(
                {"random": st.fixed_dictionaries({}, optional={"low": st.floats(-9, 0.5)})}
            ),
            st.fixed_dictionaries({"run": TEXT.filter(bool)}, optional={"step": st.none() | COUNT}),
        ),
        "evaluation": st.none() | st.fixed_dictionaries({"every": COUNT, "trials": st.integers(1, 10**6)}),
        "log": st.none()
        | st.fixed_dictionaries({}, optional={"every_steps": COUNT, "episodes": st.integers(1, 99)}),
        "snapshots": st.fixed_dictionaries({}, optional={"every": st.none() | COUNT}),
        "recording": st.fixed_dictionaries(
            {}, optional={**RECORDING, "compression": st.sampled_from(["zstd", "lz4", "none"])}
        )
        | st.fixed_dictionaries({"level": st.integers(-7, 19)}, optional=RECORDING),
        "quirks": QUIRKS,
        "branches": st.lists(
            st.fixed_dictionaries(
                {"run": st.text("abcdefgh", min_size=1), "step": st.integers(0, 10**12)},
                optional={
                    "actions": st.dictionaries(st.sampled_from(["taxi_1", "taxi_2"]), st.just("north")),
                    "settings": st.fixed_dictionaries(
                        {}, optional={"epsilon": st.floats(0, 1), "quirks": QUIRKS}
                    ),
                },
            ),
            max_size=3,
        ),
    },
)
EXPERIMENTS = st.builds(lambda rest, learners, seeds: {**rest, **learners, **seeds}, REST, LEARNERS, SEEDS)


@given(EXPERIMENTS)
def test_a_config_survives_a_round_trip_as_mapping(values):
    config = from_mapping(values)
    plain = config.to_mapping()
    assert json.loads(json.dumps(plain)) == plain
    assert from_mapping(plain) == config
    assert from_mapping(plain).to_mapping() == plain


@given(EXPERIMENTS)
def test_a_config_survives_a_round_trip_as_yaml(tmp_path_factory, values):
    config = from_mapping(values)
    path = tmp_path_factory.mktemp("written") / "x.yaml"
    path.write_text(config.to_yaml(), encoding="utf-8", newline="")
    assert load(path) == config


@given(EXPERIMENTS)
def test_loading_accepts_what_the_schema_allows(values):
    validator = Draft202012Validator(json_schema())
    validator.validate(values)
    validator.validate(from_mapping(values).to_mapping())
