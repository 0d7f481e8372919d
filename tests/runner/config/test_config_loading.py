"""Configurations from files, Python values and overrides."""

import copy
import pickle
import subprocess
import sys

import pytest
from pydantic import ValidationError

from runner.config import ExperimentConfig, from_mapping, load
from runner.config.sections import Exponential, Linear, Piecewise, RandomTable, RunTable
from runner.errors import ConfigError


@pytest.fixture
def write(tmp_path):
    def write_file(text, name="first.yaml"):
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return write_file


def test_a_file_needs_only_episodes(write):
    config = load(write("episodes: 12\n"))
    assert (config.name, config.episodes, config.seeds) == ("first", 12, (0,))
    assert (config.mode, config.tables, config.rewards) == ("cooperative", "joint", "team")
    assert (config.algorithm, config.step_size, config.discount, config.epsilon) == (
        "q_learning",
        0.1,
        0.95,
        0.1,
    )
    assert (config.exploration, config.initial_q) == ("shared", 0.0)
    assert (config.env.id, dict(config.env.kwargs)) == ("dualtaxi:DualTaxi-v1", {})
    assert (config.evaluation.every, config.evaluation.trials) == (1000, 200)
    assert (config.log.every_steps, config.log.window, config.log.episodes) == (50_000, 50_000, 50)
    assert config.snapshots.every is None
    recording = config.recording
    assert (recording.steps, recording.compression, recording.level) == ("all", "zstd", 3)
    assert (recording.index, recording.chunk_steps) == ("message", 16_384)
    assert set(dict(config.quirks).values()) == {False}


def test_a_path_may_be_text(write):
    assert load(str(write("episodes: 1"))) == load(write("episodes: 1"))


def test_a_file_can_name_itself(write):
    assert load(write("name: other\nepisodes: 1\n")).name == "other"
    assert load(write("name: other\nepisodes: 1\n", "not a name.yaml")).name == "other"


def test_a_byte_order_mark_and_windows_lines_are_read(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_bytes(b"\xef\xbb\xbfepisodes: 3\r\nseed: 4\r\n")
    assert load(path).seeds == (4,)


@pytest.mark.parametrize(
    ("given", "tables", "rewards", "mode"),
    [
        ({}, "joint", "team", "cooperative"),
        ({"mode": "cooperative"}, "joint", "team", "cooperative"),
        ({"mode": "competitive"}, "per_agent", "individual", "competitive"),
        ({"mode": "competitive", "tables": "per_agent"}, "per_agent", "individual", "competitive"),
        ({"mode": "cooperative", "tables": "joint", "rewards": "team"}, "joint", "team", "cooperative"),
        ({"tables": "joint"}, "joint", "team", "cooperative"),
        ({"rewards": "team"}, "joint", "team", "cooperative"),
        ({"tables": "per_agent"}, "per_agent", "individual", "competitive"),
        ({"rewards": "individual"}, "per_agent", "individual", "competitive"),
        ({"tables": "per_agent", "rewards": "team"}, "per_agent", "team", None),
    ],
)
def test_mode_tables_and_rewards_agree(given, tables, rewards, mode):
    config = from_mapping({"episodes": 1, **given})
    assert (config.tables, config.rewards, config.mode) == (tables, rewards, mode)


@pytest.mark.parametrize(
    ("given", "seeds"),
    [
        ({}, (0,)),
        ({"seed": 7}, (7,)),
        ({"seed": 2**64 - 1}, (2**64 - 1,)),
        ({"seeds": [3, 1, 2]}, (3, 1, 2)),
        ({"seeds": {"first": 5, "count": 3}}, (5, 6, 7)),
        ({"seeds": {"count": 2}}, (0, 1)),
    ],
)
def test_seeds(given, seeds):
    assert from_mapping({"episodes": 1, **given}).seeds == seeds


def test_schedules(write):
    config = load(
        write(
            """
            episodes: 1
            step_size: {schedule: exponential, start: 1, factor: 0.999, floor: 0.1}
            discount: {schedule: piecewise, points: [[0, 0.5], [1000, 0.9]], by: step}
            epsilon:
              schedule: linear
              start: 1.0
              end: 0.05
              over: 400
            """
        )
    )
    assert config.step_size == Exponential(start=1.0, factor=0.999, by="episode", floor=0.1)
    assert config.discount == Piecewise(points=((0, 0.5), (1000, 0.9)), by="step", floor=0.0)
    assert config.epsilon == Linear(start=1.0, end=0.05, over=400)


def test_initial_q():
    def initial_q(value):
        return from_mapping({"episodes": 1, "initial_q": value}).initial_q

    assert initial_q(-3) == -3.0
    assert initial_q("random") == initial_q({"random": {}}) == initial_q({"random": {"low": 0, "high": 1}})
    drawn = initial_q({"random": {"low": -1}})
    assert isinstance(drawn, RandomTable)
    assert (drawn.random.low, drawn.random.high) == (-1.0, 1.0)
    assert initial_q({"run": "quick-1"}) == RunTable(run="quick-1", step=None)
    assert initial_q({"run": "quick-1", "step": 0}) == RunTable(run="quick-1", step=0)


def test_numbers_are_parsed_as_in_yaml_1_2(write):
    assert load(write("episodes: 1\nepsilon: 1e-3")).epsilon == 0.001
    assert load(write("episodes: 1\nstep_size: 1E-2")).step_size == 0.01
    assert load(write("episodes: 1\ninitial_q: -.5")).initial_q == -0.5
    assert isinstance(load(write("episodes: 1\nepsilon: 1")).epsilon, float)
    assert load(write("episodes: 010")).episodes == 10


def test_words_and_dates_stay_text(write):
    kwargs = load(
        write("episodes: 1\nenv: {kwargs: {a: no, b: on, c: 2026-11-01, d: 12:30:00, e: 1_000}}")
    ).env.kwargs
    assert dict(kwargs) == {"a": "no", "b": "on", "c": "2026-11-01", "d": "12:30:00", "e": "1_000"}


def test_anchors_may_be_used(write):
    config = load(
        write(
            "episodes: 1\nepsilon: &decay {schedule: linear, start: 1, end: 0.1, over: 9}\nstep_size: *decay"
        )
    )
    assert config.step_size == config.epsilon


def test_null_turns_evaluation_and_log_off():
    config = from_mapping({"episodes": 1, "evaluation": None, "log": None})
    assert config.evaluation is None
    assert config.log is None


def test_only_zstd_has_a_level():
    assert from_mapping({"episodes": 1, "recording": {"level": -7}}).recording.level == -7
    assert from_mapping({"episodes": 1, "recording": {"compression": "lz4"}}).recording.level is None


def test_a_config_does_not_change():
    given = {"episodes": 1, "env": {"kwargs": {"a": [1, {"b": 2}]}}, "seeds": [1, 2]}
    config = from_mapping(given)
    for change in (
        lambda: setattr(config, "episodes", 2),
        lambda: setattr(config.recording, "steps", "none"),
        lambda: setattr(config, "other", 2),
    ):
        with pytest.raises(ValidationError):
            change()
    with pytest.raises(TypeError):
        config.env.kwargs["a"] = 1  # type: ignore[index]
    given["env"]["kwargs"]["a"][1]["b"] = 3
    assert config.env.kwargs["a"][1]["b"] == 2
    config.to_mapping()["env"]["kwargs"]["a"].append(4)
    assert len(config.env.kwargs["a"]) == 2


def test_a_config_can_be_compared_hashed_copied_and_sent_to_another_process():
    config = from_mapping({"episodes": 1, "env": {"kwargs": {"a": [1, {"b": 2}]}}, "epsilon": 0.2})
    other = from_mapping({"episodes": 2})
    assert config != other
    assert len({config, copy.deepcopy(config), pickle.loads(pickle.dumps(config)), other}) == 2


@pytest.mark.parametrize(
    ("override", "attribute", "value"),
    [
        ("episodes=7", "episodes", 7),
        ("epsilon=1e-2", "epsilon", 0.01),
        (" epsilon = 0.5 ", "epsilon", 0.5),
        ("evaluation.trials=5", "evaluation.trials", 5),
        ("evaluation=null", "evaluation", None),
        ("recording.compression=none", "recording.compression", "none"),
        ("env.kwargs.size=4", "env.kwargs", {"size": 4}),
        ("epsilon={schedule: linear, start: 1, end: 0, over: 9}", "epsilon", Linear(start=1, end=0, over=9)),
        ("step_size.floor=0.2", "step_size.floor", 0.2),
        ("discount.points.1.1=0.6", "discount.points", ((0, 0.5), (10, 0.6))),
        ("seed=3", "seeds", (3,)),
        ("seeds=[3, 4]", "seeds", (3, 4)),
        ("mode=competitive", "rewards", "individual"),
    ],
)
def test_overrides(write, override, attribute, value):
    path = write(
        "episodes: 1\nseed: 9\ntables: joint\nrewards: team\n"
        "step_size: {schedule: exponential, start: 1, factor: 0.9, floor: 0.1}\n"
        "discount: {schedule: piecewise, points: [[0, 0.5], [10, 0.9]]}\n"
    )
    found = load(path, [override])
    for name in attribute.split("."):
        found = getattr(found, name)
    assert found == value


def test_an_override_changes_only_what_it_names():
    config = from_mapping({"episodes": 1}, ["evaluation.every=10"])
    assert (config.evaluation.every, config.evaluation.trials) == (10, 200)
    config = from_mapping({"episodes": 1, "evaluation": {"every": 5, "trials": 6}}, ["evaluation.every=10"])
    assert (config.evaluation.every, config.evaluation.trials) == (10, 6)


def test_overrides_may_build_a_schedule_one_by_one_and_the_last_wins():
    overrides = [
        "epsilon.schedule=linear",
        "epsilon.start=1",
        "epsilon.end=0",
        "epsilon.over=5",
        "epsilon.over=6",
    ]
    assert from_mapping({"episodes": 1, "epsilon": 0.3}, overrides).epsilon == Linear(start=1, end=0, over=6)


def test_overrides_leave_the_given_mapping_alone():
    given = {"episodes": 1, "env": {"kwargs": {"a": 1}}}
    before = copy.deepcopy(given)
    from_mapping(given, ["env.kwargs.a=2", "episodes=3"])
    assert given == before


def test_an_override_can_correct_the_file(write):
    assert load(write("epsilon: 3\nepisodes: x\n"), ["epsilon=0.3", "episodes=1"]).epsilon == 0.3


def test_a_resolved_experiment_takes_overrides_too():
    resolved = from_mapping({"episodes": 1, "seeds": [1, 2]}).to_mapping()
    config = from_mapping(resolved, ["seed=5", "mode=competitive"])
    assert (config.seeds, config.tables) == ((5,), "per_agent")


def test_the_constructor_checks_its_arguments():
    with pytest.raises(ValidationError):
        ExperimentConfig(name="a", episodes=1, tables="joint", rewards="individual", seeds=(0,))
    with pytest.raises(ConfigError):
        from_mapping({"episodes": 1}, name="not a name")


def test_importing_it_is_cheap():
    heavy = "numpy", "gymnasium", "numba", "rerun", "mcap", "rich", "click"
    script = f"import sys, runner.config; print(*sorted(set({heavy}) & set(sys.modules)))"
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert ran.stdout.split() == []


def test_separate_learners_explore_independently_unless_the_file_names_another_exploration(write):
    assert load(write("episodes: 1\nmode: competitive")).exploration == "independent"
    assert load(write("episodes: 1\ntables: per_agent\nrewards: team")).exploration == "independent"
    assert load(write("episodes: 1\nmode: competitive\nexploration: shared")).exploration == "shared"
    assert load(write("episodes: 1"), ["mode=competitive"]).exploration == "independent"


def test_a_resolved_configuration_keeps_its_exploration(write):
    """Recordings hold resolved configurations; a changed default must not change what they mean."""
    stored = load(write("episodes: 1\nmode: competitive\nexploration: shared")).to_mapping()
    assert stored["exploration"] == "shared"
    assert from_mapping(stored).exploration == "shared"
    joint = load(write("episodes: 1")).to_mapping()
    assert joint["exploration"] == "shared"


def test_overriding_the_algorithm_removes_the_section_of_the_old_one(write):
    file = write(
        "episodes: 1\nmode: competitive\nalgorithm: hysteretic_q_learning\nhysteretic: {decrease: 0.05}"
    )
    assert load(file, ["algorithm=q_learning"]).hysteretic is None
    assert load(file, ["algorithm=hysteretic_q_learning"]).hysteretic.decrease == 0.05
    other = load(file, ["algorithm=wolf_phc", "wolf_phc.win=0.01"])
    assert (other.hysteretic, other.wolf_phc.win) == (None, 0.01)
    with pytest.raises(ConfigError, match="goes with algorithm: hysteretic_q_learning"):
        load(file, ["algorithm=q_learning", "hysteretic.decrease=0.1"])
