"""Episodes are found in all runs, by their index where it decides, and by their steps where it does not."""

from __future__ import annotations

import json
import os
import shutil

import gymnasium
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import runner
from dualtaxi.parallel import DualTaxiParallelEnv
from runner.analysis.evaluations import evaluations_of
from runner.archive.batches import Batches
from runner.archive.runs import archive_run
from runner.cli import cli
from runner.errors import RunnerError
from runner.query.episode_index import EpisodeParser
from runner.query.sql_views import SelectedRuns
from runner.recording.reader import open_recording
from runner.runs.resolve import find_run
from runner.util.files import CACHE_VARIABLE, CACHED_EPISODES, cache_folder
from tests.runner.recording.making import LAKE, TAXIS, make_run


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with jobs, a loop of a pole, and one of several poles."""
    folder = tmp_path_factory.mktemp("runs")
    runner.label(make_run(folder, TAXIS), tag=["fast"])
    make_run(folder, LAKE)
    rng = np.random.default_rng(0)
    with runner.record(gymnasium.make("CartPole-v1"), folder, name="pole") as env:
        for seed in range(80):
            env.reset(seed=seed)
            for _ in range(int(rng.integers(5, 200))):
                *_, terminated, truncated, _ = env.step(int(rng.integers(2)))
                if terminated or truncated:
                    break
    envs = gymnasium.make_vec("CartPole-v1", 3, vectorization_mode="sync")
    with runner.record_vector(envs, folder, name="poles") as recorded:
        recorded.action_space.seed(2)
        recorded.reset(seed=7)
        for _ in range(300):
            recorded.step(recorded.action_space.sample())
    return folder


EXPRESSIONS = [
    "ret < -100 and count(collision) >= 2 and length > 50",
    'any(action == "north + east")',
    'any(action.taxi_1 == "north") and not success',
    'count(action in ("north + east", "east + east")) > 3',
    "never(collision)",
    "all(reward < 0)",
    "then(pickup, drop_off, within=5)",
    "then(pickup, drop_off)",
    "any(taxi_1.pickup and reward.taxi_2 < 0)",
    "count(pickup) == 1 or count(not collision) < 10",
    "count(pickup or collision) * 2 > length / 4",
    "max(t) > 60 and sum(reward) < -200",
    "any(state > 20) and last(next_state) != 5",
    "ret.taxi_1 > ret.taxi_2",
    "any(explored and t > 80)",
    "abs(ret + length) > 100",
    "truncated and 10 < length",
    "any(next_observation[2] > 0.2)",
    "all(abs(next_observation[2]) < 0.1)",
    "max(next_observation[0]) - min(next_observation[0]) > 0.1",
    "last(next_observation[3]) < 0 < first(next_observation[3])",
    "not any(next_observation[2] > 0.2 and action == 1)",
    "count(next_observation[1] > 0) >= 10",
    "all(next_observation[2] == next_observation[2])",
    "count(action == 1) > 0.6 * length",
    "any(reward == -2) and not all(reward >= -2)",
    "count(action < 2) > 3",
]


@pytest.mark.parametrize("expression", EXPRESSIONS)
def test_the_index_finds_what_the_steps_say(folder, expression, monkeypatch):
    found = runner.find(expression, folder, limit=None)
    monkeypatch.setattr(EpisodeParser, "_column", lambda *_: "NULL")
    by_steps = runner.find(expression, folder, limit=None)
    assert found == by_steps
    assert found.count


def expected_of(folder, name, holds):
    """Return the references of the training episodes whose recorded steps satisfy a function."""
    with open_recording(find_run(name, folder).recording) as recording:
        episodes = recording.train.episodes.array()
        return [str(row["episode"]) for row in episodes if holds(recording, row)]


@pytest.mark.parametrize("name", ["pole", "poles"])
def test_hits_are_what_the_recording_says(folder, name):
    def leans(recording, row):
        steps = recording.train.episode_steps(int(row["episode"]))
        return bool((steps["next_observation"][:, 2] > 0.2).any())

    expected = expected_of(folder, name, leans)
    for expression in ("any(next_observation[2] > 0.2)", "any(next_observation[2] + 0 > 0.2)"):
        found = runner.find(expression, folder, runs=f'name == "{name}"', limit=None)
        assert [hit.at for hit in found.hits] == expected
    assert expected


def test_events_are_counted_at_their_steps(folder):
    run = find_run("taxis", folder)
    found = runner.find("length > 0", folder, runs="taxis", limit=None)
    with open_recording(run.recording) as recording:
        assert found.count == sum(phase.episodes.count() for phase in recording.phases)
    steps = runner.sql(
        "SELECT count_if(collision) c, count_if(pickup) p FROM steps", recordings=folder
    ).arrow()
    totals = [sum(hit.events.get(name, 0) for hit in found.hits) for name in ("collision", "taxi_1_pickup")]
    assert totals[0] == steps["c"][0].as_py()
    assert totals[1] <= steps["p"][0].as_py()


def test_indexes_and_views_have_the_same_columns_in_every_process(folder):
    with open_recording(find_run("taxis", folder).recording) as recording:
        names = list(Batches(recording).shape.event_masks)
    assert names[:6] == [
        "taxi_1_pickup",
        "pickup",
        "taxi_2_pickup",
        "taxi_1_drop_off",
        "drop_off",
        "taxi_2_drop_off",
    ]
    query = runner.sql("SELECT * FROM steps", recordings=folder, runs="taxis")
    events = [name for name in query.columns.names if name in names]
    query.close()
    assert events == [name for name in names if name in events]


def test_what_the_index_decides_reads_no_recording(folder, monkeypatch):
    runner.find("length > 0", folder)

    def refuse(*_):
        raise AssertionError("steps were read")

    monkeypatch.setattr(SelectedRuns, "table", refuse)
    for expression in (*EXPRESSIONS[:3], "count(action == 1) > 5", "any(next_observation[2] > 0.2)"):
        assert runner.find(expression, folder).count


def test_a_hit_is_the_episode(folder):
    (hit,) = runner.find("length > 0", folder, runs="taxis", phase="eval", sort="-length", limit=1).hits
    with open_recording(find_run(hit.run_id, folder).recording) as recording:
        record = max(recording.eval.episodes.array(), key=lambda row: row["length"])
    assert (hit.length, hit.ret) == (record["length"], record["returns"].sum())
    assert hit.at.startswith("eval:")
    assert hit.replay == f"/runs/{hit.run_id}/replay/{hit.at.replace(':', '/')}"
    assert runner.mark(find_run(hit.run_id, folder), hit.at, "slow").text == "slow"
    (marked,) = runner.find("length > 0", folder, runs="taxis", phase="eval", sort="-length", limit=1).hits
    assert marked.marks == ["slow"]


def test_words_search_names_and_tags(folder):
    assert runner.find("fast", folder).count == runner.find("length > 0", folder, runs="taxis").count


def test_sorting_and_limits(folder):
    for sort in ("max(next_observation[2]) * 1", "-sum(reward)", "ret"):
        every = runner.find("length > 10", folder, runs="pole", sort=sort, limit=None)
        some = runner.find("length > 10", folder, runs="pole", sort=sort, limit=5)
        assert some.hits == every.hits[:5]
        assert some.count == len(every.hits)
    returns = [hit.ret for hit in every.hits]
    assert returns == sorted(returns)


@pytest.mark.parametrize(
    ("expression", "mark", "message"),
    [
        ("retr < 3", "^^^^", "Did you mean 'ret'"),
        ("any(colision)", "^^^^^^^^", "Did you mean 'collision'"),
        ('any(action == "nort + east")', "^^^^^^^^^^^^^", "Did you mean 'north + east'"),
        ("ret.taxi_3 < 1", "^^^^^^^^^^", "Did you mean"),
        ("collision and ret < 3", "^^^^^^^^^", "any(collision)"),
        ("any(any(collision))", "^^^^^^^^^^^^^^", "values of a step"),
        ("cuont(collision) > 1", "^^^^^", "Did you mean 'count'"),
        ("any(collision, within=3)", "^^^^^^^^^^^^^^^^^^^^^^^^", "within=STEPS"),
        ("then(collision, collision, within=0)", "^", "found within=0, expected a whole number of steps"),
        ("then(collision, collision, within=-1)", "^^", "found within=-1, expected a whole number of steps"),
        ("then(collision, collision, after=3)", "^" * 35, "then() alone has within=STEPS"),
        ("seed == 3", "^^^^", "expected one of"),
        ("any(next_observation[-1] > 1)", "^^^^^^^^^^^^^^^^^^^^", "expected one of"),
        ("length >", "^", "invalid syntax"),
        ("(length + 1)", "^^^^^^^^^^", "expected a condition"),
        ("__import__('os').system('x') == 0", "^", "found"),
        ("length == 'x\" OR 1=1 --'", "^", "found text"),
    ],
)
def test_a_mistake_is_marked(folder, expression, mark, message):
    with pytest.raises(RunnerError) as error:
        runner.find(expression, folder, runs="taxis")
    assert message in str(error.value)
    assert str(error.value).endswith(mark)


def test_a_run_that_cannot_be_searched_is_named(folder, tmp_path):
    runs = tmp_path / "runs"
    shutil.copytree(folder, runs)
    bare = make_run(runs, TAXIS | {"name": "bare", "recording": {"steps": "none"}})
    damaged = make_run(runs, TAXIS | {"name": "hurt"})
    damaged.recording.write_bytes(damaged.recording.read_bytes()[:700])
    with runner.record(gymnasium.make("CartPole-v1"), runs, name="begun") as env:
        env.reset()
        env.step(0)
    found = runner.find("then(taxi_1.pickup, taxi_1.drop_off, within=5)", runs)
    reasons = "\n".join(found.left_out)
    assert f"{bare.run_id} is left out of steps: it has no steps" in reasons
    assert damaged.run_id in reasons
    assert found.runs == 1
    assert runner.find("count(collision) > 1", runs, runs="bare").count  # from the index alone


@pytest.mark.parametrize("expression", ["0/0 > 2", "0/0 == 0/0", "any(t/t > 2)", "1/0 - 1/0 > 0"])
def test_nan_compares_as_false(folder, expression):
    assert not runner.find(expression, folder).count


def test_a_run_that_is_damaged_in_its_steps_is_left_out_each_time(tmp_path):
    run = make_run(tmp_path, TAXIS)
    with open_recording(run.recording) as recording:
        entry = recording.train.steps.entry(len(recording.train.steps) - 1)
    with run.recording.open("r+b") as stream:
        stream.seek(entry.offset + entry.length // 2)
        stream.write(b"damage")
    for _ in range(2):
        found = runner.find("length > 0", tmp_path)
        assert not found.count
        assert found.left_out[0].startswith(f"run {run.run_id} is left out of find: ")


def test_a_finished_run_whose_recording_is_cut_off_is_left_out(tmp_path):
    run = make_run(tmp_path, TAXIS)
    os.truncate(run.recording, run.recording.stat().st_size // 2)
    assert "is cut off, though its run is finished" in runner.find("length > 0", tmp_path).left_out[0]
    for view in ("episodes", "steps"):
        result = runner.sql(f"SELECT count(*) AS n FROM {view}", recordings=tmp_path)
        assert result.arrow().to_pylist() == [{"n": 0}]
        assert "is cut off, though its run is finished" in result.left_out[0]


def test_a_run_is_left_out_whose_older_index_cannot_be_removed(tmp_path, monkeypatch):
    def refuse(path, missing_ok=False):
        raise PermissionError(13, "Permission denied")

    run = make_run(tmp_path, LAKE)
    assert runner.find("length > 0", tmp_path).count
    os.utime(run.recording)
    monkeypatch.setattr("pathlib.Path.unlink", refuse)
    (reason,) = runner.find("length > 0", tmp_path).left_out
    assert "Permission denied" in reason


def test_trials_of_an_evaluation_that_was_cut_off_are_found(tmp_path):
    run = make_run(tmp_path, LAKE, evaluation={"every": 6, "trials": 60_000}).update(status="interrupted")
    os.truncate(run.recording, run.recording.stat().st_size // 10)
    with open_recording(run.recording) as recording:
        ended = recording.eval.episodes.count()
        assert ended > 2 * len(evaluations_of(recording))
    found = runner.find("length > 0", tmp_path, phase="eval", limit=2)
    assert found.count == ended
    assert [(hit.at, hit.replay) for hit in found.hits] == [("eval:-1:0", ""), ("eval:-1:1", "")]
    assert not found.mark("nowhere")


def test_a_recording_that_changed_is_read_again(tmp_path):
    first, second = (make_run(tmp_path / name, TAXIS | {"episodes": n}) for name, n in (("a", 20), ("b", 40)))
    assert runner.find("length > 0", tmp_path / "a", phase="train").count == 20
    shutil.copy(second.recording, first.recording)
    assert runner.find("length > 0", tmp_path / "a", phase="train").count == 40
    assert len(list((cache_folder() / CACHED_EPISODES).glob(f"{first.run_id}-*"))) == 1


def test_removing_a_run_removes_its_index(tmp_path):
    run = make_run(tmp_path, LAKE)
    assert runner.find("length > 0", tmp_path).count
    assert list((cache_folder() / CACHED_EPISODES).glob(f"{run.run_id}-*"))
    result = CliRunner().invoke(cli, ["rm", run.run_id, "--yes", "--recordings", str(tmp_path)])
    assert result.exit_code == 0, result.output
    assert not list((cache_folder() / CACHED_EPISODES).glob(f"{run.run_id}-*"))


def test_an_archived_run_has_the_same_hits(tmp_path):
    run = make_run(tmp_path / "runs", TAXIS)
    expressions = ("count(collision) > 1", "then(pickup, drop_off)")
    before = [runner.find(expression, tmp_path / "runs", limit=None).hits for expression in expressions]
    archive_run(run, str(tmp_path / "archive"), remove=True)
    after = [runner.find(expression, tmp_path / "runs", limit=None).hits for expression in expressions]
    assert after == before
    shutil.rmtree(tmp_path / "archive")
    assert runner.find(expressions[0], tmp_path / "runs", limit=None).hits == before[0]
    found = runner.find(expressions[1], tmp_path / "runs")
    assert (found.count, len(found.left_out)) == (0, 1)


HOSTILE = ['x"); DROP TABLE hits; --', "a'b", 'say "n"', "ünï cöde", "A", "a"]


def test_names_that_need_quoting_do_no_harm(tmp_path):
    class Odd(gymnasium.Env):
        observation_space = spaces.Dict({name: spaces.Box(-9, 9, (1,)) for name in HOSTILE})
        action_space = spaces.Discrete(2)
        t = 0

        def reset(self, **_):
            self.t = 0
            return {name: np.zeros(1, np.float32) for name in HOSTILE}, {}

        def step(self, _):
            self.t += 1
            values = {name: np.full(1, k + self.t / 8, np.float32) for k, name in enumerate(HOSTILE)}
            return values, 0.0, self.t == 4, False, {}

    with runner.record(Odd(), tmp_path, name="odd") as env:
        for _ in range(3):
            env.reset()
            for _ in range(4):
                env.step(0)
    for more in ("", " + 0"):
        for above, joined, count in ((0.4, " and ", 3), (0.6, " or ", 0)):
            expression = joined.join(
                f"any(next_observation[{name!r}][0]{more} > {k + above})" for k, name in enumerate(HOSTILE)
            )
            assert runner.find(expression, tmp_path).count == count, expression


def test_one_episode_in_a_million(tmp_path, folder):
    runner.find("length > 0", folder, runs="pole")
    source, *_ = (cache_folder() / CACHED_EPISODES).glob(f"{find_run('pole', folder).run_id}-*")
    table, n = pq.read_table(source), 50_000
    run = find_run("pole", folder)
    made = []
    for k in range(20):
        place = tmp_path / f"run{k:05d}"
        shutil.copytree(run.folder, place)
        facts = json.loads((place / "run.json").read_text()) | {"run_id": place.name}
        (place / "run.json").write_text(json.dumps(facts))
        made.append(place)
    runner.find("length > 0", tmp_path)
    files = sorted((cache_folder() / CACHED_EPISODES).glob("run00*"))
    assert len(files) == 20
    rows = table.take(np.random.default_rng(0).integers(len(table), size=n))
    rows = rows.set_column(rows.column_names.index("episode"), "episode", pa.array(np.arange(n)))
    for k, file in enumerate(files):
        planted = np.where((np.arange(n) == 31_415) & (k == 13), 9.5, 0.1)
        at = rows.column_names.index("max(next_observation_2)")
        made = rows.set_column(at, "max(next_observation_2)", pa.array(planted, pa.float32()))
        for name, values in (
            ("row", np.arange(n)),
            ("file", np.full(n, pq.read_table(file)["file"][0].as_py())),
        ):
            made = made.set_column(made.column_names.index(name), name, pa.array(values))
        pq.write_table(made, file)
    found = runner.find("any(next_observation[2] > 1)", tmp_path)
    assert [(hit.run_id, found.count) for hit in found.hits] == [("run00013", 1)]
    assert runner.find("length > 0", tmp_path, sort="ret", limit=1).count == 1_000_000


def test_the_command(folder):
    def invoke(*words):
        result = CliRunner().invoke(cli, ["find", *words, "--recordings", str(folder)])
        assert result.exit_code == 0, result.output
        return result

    expression = "count(collision) >= 1"
    found = runner.find(expression, folder)
    assert json.loads(invoke(expression, "--json").stdout) == json.loads(json.dumps(found.as_json()))
    text = invoke(expression)
    assert found.hits[0].run_id in text.stdout
    (left_out,) = [line for line in text.stderr.splitlines() if "left out" in line]
    assert left_out.startswith("3 runs are left out of find (")
    assert left_out.endswith(": each because it has no collision; a filter of runs can exclude it.")
    assert found.sentence in text.stderr


def test_a_damaged_index_is_made_again(folder):
    before = runner.find("length > 20", folder)
    for file in (cache_folder() / CACHED_EPISODES).glob("*.parquet"):
        file.write_bytes(file.read_bytes()[:40] + b"?")
    with pytest.raises(RunnerError, match="the next search makes it again"):
        runner.find("length > 20", folder)
    assert runner.find("length > 20", folder) == before


def test_the_cache_may_be_in_a_folder_with_signs_of_patterns(folder, tmp_path, monkeypatch):
    expressions = ("length > 20", "then(action == 1, action == 0)")
    expected = [runner.find(expression, folder, runs="pole") for expression in expressions]
    for name in ("x1", "x[1]", "x?", "**"):  # a pattern would match the first
        (tmp_path / name).mkdir()
        monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / name))
        for _ in range(2):
            found = [runner.find(expression, folder, runs="pole") for expression in expressions]
            assert found == expected, name


def test_a_return_that_is_no_number_matches_no_comparison(tmp_path):
    with runner.record(Paying(float("nan")), tmp_path) as env:
        env.reset(seed=0)
        env.step(0)
    assert [runner.find(f"ret {sign} 1", tmp_path).count for sign in ("<", ">=", "==")] == [0, 0, 0]
    found = runner.find("length == 1", tmp_path)
    assert [hit.ret for hit in found.hits] == [None]
    assert "–" in found.grid.rows[0]


def test_conditions_on_ends_are_no_words_and_words_that_no_run_has_are_named(tmp_path):
    with runner.record(Paying(1.0), tmp_path, name="paid") as env:
        env.reset(seed=0)
        env.step(0)
    assert runner.find("not truncated", tmp_path).count == 1
    assert runner.find("terminated and not truncated", tmp_path).count == 1
    assert runner.find("paid", tmp_path).count == 1
    assert "No run has 'collision' in its id, name" in runner.find("collision", tmp_path).sentence


class Paying(gymnasium.Env):
    """Ends with its first step, or a later one, and pays."""

    observation_space = action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, reward, length=1):
        self.reward, self.length = reward, length

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return 0, {}

    def step(self, action):
        self.t += 1
        return 1, self.reward, self.t == self.length, False, {}


def test_a_recording_that_lost_its_end_is_left_out_and_named(tmp_path):
    with runner.record(Paying(1.0), tmp_path, chunk_steps=256) as env:
        for _ in range(1_000):
            env.reset(seed=0)
            env.step(0)
    whole = env.run.recording.read_bytes()
    env.run.recording.write_bytes(whole[: 2 * len(whole) // 3])
    found = runner.find("length > 0", tmp_path)
    assert found.count == 0
    assert "is cut off, though its run is finished" in found.left_out[0]


@pytest.mark.parametrize("limit", [0, -1, 1.5])
def test_a_wrong_limit_is_refused_before_anything_is_read(tmp_path, limit):
    with pytest.raises(RunnerError, match="limit: found"):
        runner.find("length > 0", tmp_path, limit=limit)


def test_extras_are_searched(tmp_path):
    losses, agreed = {}, {}
    with runner.record(Paying(1.0, length=6), tmp_path, name="learner") as env:
        for episode in range(40):
            env.reset(seed=episode)
            for t in range(6):
                env.step(0)
                if (episode + t) % 3:
                    losses.setdefault(episode, {})[t] = episode * (t + 1) % 7 / 2
                    agreed.setdefault(episode, {})[t] = t > 3
                    env.note_step(
                        loss=losses[episode][t], agreed=agreed[episode][t], word="w", q=np.arange(2.0) + t
                    )
    expected = {
        "any(extra.loss > 2.4)": [k for k in losses if max(losses[k].values()) > 2.4],
        "count(extra.agreed) == 2": [k for k in agreed if sum(agreed[k].values()) == 2],
        "then(extra.loss >= 2, extra.agreed, within=1)": [
            k for k in losses if any(losses[k].get(t, 0) >= 2 and agreed[k].get(t + 1, 0) for t in range(6))
        ],
        "max(extra.q[1]) < 6": [k for k in losses if 5 not in losses[k]],
    }
    for expression, episodes in expected.items():
        found = runner.find(expression, tmp_path, limit=None)
        assert [int(hit.at) for hit in found.hits] == episodes, expression
        assert 0 < len(episodes) < 40
    with runner.record(Paying(1.0), tmp_path, name="stepless", steps="actions") as env:
        env.reset(seed=0)
        env.step(0)
        env.note_step(loss=9.0)
    found = runner.find("any(extra.loss > 2.4)", tmp_path, limit=None)
    assert found.count == len(expected["any(extra.loss > 2.4)"])
    assert "it has no steps; `dualtaxi rerecord`" in found.left_out[0]
    with pytest.raises(RunnerError, match="Did you mean 'extra_loss'"):
        runner.find("any(extra.los > 1)", tmp_path)
    with pytest.raises(RunnerError, match=r"found extra\.word"):
        runner.find("any(extra.word == 1)", tmp_path)
    query = "SELECT count(*) AS n, max(extra_loss) AS loss FROM steps JOIN extras USING (run, phase, step)"
    (row,) = runner.sql(query, recordings=tmp_path).arrow().to_pylist()
    assert row["n"] == sum(map(len, losses.values()))
    assert row["loss"] == 3


@pytest.mark.parametrize("way", ["NextStep", "SameStep", "batches"])
def test_extras_of_each_environment_are_searched(tmp_path, way):
    draws = np.random.default_rng(0)
    actions = draws.integers(2, size=(120, 3))
    extras = {"loss": draws.integers(50, size=(120, 3)) / 2, "q": draws.normal(size=(120, 3, 2))}
    extras["agreed"] = extras["loss"] > 12
    if way == "batches":
        over = np.zeros((120, 3), np.bool_)
        over[14::15], over[36::20, 0] = True, True
        places = draws.normal(size=(121, 3, 2)).astype(np.float32)
        with runner.record_batches(
            "Corridor", tmp_path, action_space=spaces.Discrete(2), autoreset_mode="NextStep"
        ) as rec:
            rec.batch(places, actions, over * 1.0, over, extras=extras)
    else:
        mode = AutoresetMode(way)
        envs = SyncVectorEnv([lambda: gymnasium.make("CartPole-v1")] * 3, autoreset_mode=mode)
        with runner.record_vector(envs, tmp_path) as rec:
            rec.reset(seed=0)
            for t in range(120):
                rec.step(actions[t], extras={name: values[t] for name, values in extras.items()})
    with open_recording(rec.run.recording) as recording:
        by_episode = list(map(recording.train.extras.of_episode, range(recording.train.episodes.count())))
    expected = {
        "any(extra.loss > 24)": lambda values: (values["loss"] > 24).any(),
        "count(extra.agreed) > 8": lambda values: values["agreed"].sum() > 8,
        "max(extra.q[1]) > 2": lambda values: values["q"][:, 1].max() > 2,
    }
    for expression, holds in expected.items():
        hits = runner.find(expression, tmp_path, limit=None).hits
        wanted = [k for k, values in enumerate(by_episode) if holds(values)]
        assert sorted(hit.episode for hit in hits) == wanted, expression
        assert 0 < len(wanted) < len(by_episode)


def test_actions_of_games_are_compared_with_their_names(tmp_path):
    drawn, draws = [], np.random.default_rng(0)
    with runner.record_parallel(DualTaxiParallelEnv(max_steps=6), tmp_path, name="game") as rec:
        for episode in range(12):
            rec.reset(seed=episode)
            drawn.append(set())
            while rec.agents:
                actions = {agent: int(draws.integers(rec.action_space(agent).n)) for agent in rec.agents}
                drawn[-1].add(int(actions["taxi_2"]))
                rec.step(actions)
    with open_recording(rec.run.recording) as recording:
        north = recording.train.action_names("taxi_2").index("north")
    hits = runner.find('any(action.taxi_2 == "north")', tmp_path, limit=None).hits
    wanted = [k for k, actions in enumerate(drawn) if north in actions]
    assert [int(hit.at) for hit in hits] == wanted
    assert 0 < len(wanted) < 12
    with pytest.raises(RunnerError, match="Did you mean 'south'"):
        runner.find('any(action.taxi_2 == "souht")', tmp_path)


def test_hits_are_exported(tmp_path, folder):
    words = ["length > 20 and length < 30", "--limit", "0", "--recordings", str(folder)]
    result = CliRunner().invoke(cli, ["find", "--quiet", *words])
    lines = [line.split() for line in result.stdout.splitlines()]
    found = runner.find(words[0], folder, limit=None)
    hits = {(hit.run_id, hit.phase, str(hit.episode)) for hit in found.hits}
    assert {(run, phase, n) for run, phase, numbers in lines for n in numbers.split(",")} == hits
    for k, (run, phase, episodes) in enumerate(lines):
        table = str(tmp_path / str(k))
        selected = ["--phase", phase, "--episodes", episodes, "-o", table, "--recordings", str(folder)]
        result = CliRunner().invoke(cli, ["export", "parquet", run, *selected])
        assert result.exit_code == 0, result.output
        exported = pq.read_table(f"{table}/episodes.parquet")
        assert len(exported) == len(episodes.split(","))
        assert all(20 < length < 30 for length in exported["length"].to_pylist())
    both = CliRunner().invoke(cli, ["find", "--quiet", "--json", *words])
    assert both.exit_code == 2


def test_hits_are_marked(tmp_path, folder):
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    words = ["find", "length > 20 and success", "--limit", "3", "--recordings", str(tmp_path), "--json"]
    marking = [*words, "--mark", "odd", "--tag", "b", "--tag", "a"]
    hits = json.loads(CliRunner().invoke(cli, words).stdout)["hits"]
    answers = [json.loads(CliRunner().invoke(cli, marking).stdout) for _ in range(2)]
    assert [answer["marked"] for answer in answers] == [3, 0]
    (run_id,) = {hit["run_id"] for hit in hits}
    marks = [mark for mark in find_run(run_id, tmp_path).marks if mark.text == "odd"]
    assert sorted(mark.at for mark in marks) == sorted(f"{hit['at']}:0" for hit in hits)
    assert {mark.tags for mark in marks} == {("a", "b")}
    assert runner.find("length > 20 and success", tmp_path, limit=4).mark("odd") == 1
    wrong = CliRunner().invoke(cli, [*words, "--mark", "odd one", "--tag", "no tag!"])
    assert wrong.exit_code == 2
    assert "found 'no tag!', expected 1 to 64 letters" in wrong.output
    assert "regex" not in wrong.output
    wrong = CliRunner().invoke(cli, [*words, "--tag", "odd"])
    assert wrong.exit_code == 2
    assert "--tag needs --mark" in wrong.output


def test_runs_with_the_same_episodes_have_the_same_hits(tmp_path, folder):
    run = find_run("pole", folder)
    for k in range(3):
        place = tmp_path / f"run{k:05d}"
        shutil.copytree(run.folder, place)
        facts = json.loads((place / "run.json").read_text()) | {"run_id": place.name, "name": f"pole{k % 2}"}
        (place / "run.json").write_text(json.dumps(facts))
    alone = runner.find("length > 20 and any(action == 1)", folder, runs='name == "pole"').count
    assert alone
    assert runner.find("length > 20 and any(action == 1)", tmp_path).count == 3 * alone
    assert (
        runner.find("length > 20 and any(action == 1)", tmp_path, runs='name == "pole0"').count == 2 * alone
    )


def test_a_number_to_sort_by_is_checked_as_a_condition_is(folder):
    for sort, message in (
        ("-" * 900 + "ret", ""),
        ("ret +", "invalid syntax"),
        ("rett", "Did you mean 'ret'"),
    ):
        with pytest.raises(RunnerError, match="expression: ") as error:
            runner.find("length > 0", folder, sort=sort)
        assert message in str(error.value)
