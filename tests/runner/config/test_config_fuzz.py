"""Any values and any text give a configuration, or errors that people can read."""

from hypothesis import given
from hypothesis import strategies as st

from runner.config import from_mapping, load
from runner.errors import ConfigError

WORDS = st.sampled_from(
    [
        "name",
        "env",
        "mode",
        "tables",
        "rewards",
        "algorithm",
        "episodes",
        "seed",
        "seeds",
        "step_size",
        "discount",
        "epsilon",
        "exploration",
        "initial_q",
        "evaluation",
        "log",
        "snapshots",
        "recording",
        "quirks",
        "id",
        "kwargs",
        "schedule",
        "start",
        "end",
        "over",
        "points",
        "run",
        "random",
        "every",
        "level",
        "linear",
        "piecewise",
        "exponential",
        "zstd",
        "lz4",
        "joint",
        "competitive",
    ]
)


ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5) | WORDS,
    lambda some: st.lists(some, max_size=4) | st.dictionaries(WORDS | st.text(max_size=3), some, max_size=5),
    max_leaves=20,
)


def lines_of(call):
    """Return the lines of the error that `call` raises; empty without one."""
    try:
        call()
    except ConfigError as error:
        return str(error).split("\n")
    return []


@given(st.dictionaries(WORDS | st.text(max_size=3), ANYTHING, max_size=8))
def test_any_mapping_gives_a_config_or_readable_errors(values):
    for line in lines_of(lambda: from_mapping(values)):
        assert line.isprintable()
        assert len(line) < 400
        for leak in ("pydantic", "http", "Input should", "valid", "validation", "None", "True", "dict"):
            assert leak not in line or leak in repr(values)


@given(st.text(max_size=40) | st.text("[]{}:,-&*!|> \n\t#'\"%@ab1", max_size=40), st.booleans())
def test_any_text_gives_a_config_or_readable_errors(tmp_path_factory, text, as_override):
    path = tmp_path_factory.mktemp("texts") / "x.yaml"
    path.write_bytes(b"episodes: 1\n" if as_override else text.encode(errors="surrogatepass"))
    overrides = [f"epsilon={text}"] if as_override else []
    assert all(line.isprintable() for line in lines_of(lambda: load(path, overrides)))
