"""Every export, read back by the tool it is for, equals the recording exactly."""

from __future__ import annotations

import json
import sys
import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pyarrow.csv
import pyarrow.parquet
import pytest
from click.testing import CliRunner

import runner
from runner.cli import cli
from runner.export.tables import measures
from runner.recording import schema
from runner.recording.machine import read_clock
from runner.recording.reader import open_recording
from tests.runner.recording.making import LAKE, TAXIS, make_run


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("tools")


@pytest.fixture(scope="module")
def taxis(folder):
    return make_run(folder, TAXIS)


@pytest.fixture(scope="module")
def bare(folder):
    return make_run(folder, LAKE, recording={"steps": "none"}, name="bare")


@pytest.fixture(scope="module")
def killed(folder, taxis):
    """A recording that was cut off, alone in its folder."""
    (folder / "cut").mkdir()
    path = folder / "cut" / "recording.mcap"
    data = taxis.recording.read_bytes()
    summary = int.from_bytes(data[-28:-20], "little")  # the footer has where it begins
    path.write_bytes(data[: summary - 50])
    return path


@pytest.fixture
def export(tmp_path, monkeypatch):
    """The command, in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def call(*words, code=0):
        result = CliRunner().invoke(cli, ["export", *map(str, words)])
        assert result.exit_code == code, result.output
        return result

    return call


def steps_of(path, phase, start=0, stop=None):
    with open_recording(path) as recording:
        return np.concatenate([b.copy() for b in recording.phase(phase).steps_of_episodes(start, stop)])


def read_table(path):
    if path.suffix == ".parquet":
        return pyarrow.parquet.read_table(path)
    return pyarrow.csv.read_csv(path)


@pytest.mark.parametrize("words", [["csv"], ["csv", "--gz"], ["parquet"]], ids=" ".join)
def test_tables_hold_every_step_episode_and_measure(export, taxis, words):
    export(*words, taxis.recording, "-o", "out")
    ending = ".csv.gz" if "--gz" in words else f".{words[0]}"
    steps, episodes, metrics = (
        read_table(Path("out", name + ending)).to_pandas() for name in ("steps", "episodes", "metrics")
    )
    for phase in ("train", "eval"):
        recorded = steps_of(taxis.recording, phase)
        found = steps[steps["phase"] == phase]
        for name in ("step", "episode", "t", "state", "action", "next_state", "terminated", "truncated"):
            assert (found[name].to_numpy() == recorded[name]).all(), name
        for i, agent in enumerate(("taxi_1", "taxi_2")):
            assert (found[f"reward_{agent}"].to_numpy() == recorded["rewards"][:, i]).all()
        assert (found["action_taxi_1"] * 6 + found["action_taxi_2"] == found["action"]).all()
        with open_recording(taxis.recording) as recording:
            ended = recording.phase(phase).episodes.array()
        found = episodes[episodes["phase"] == phase]
        for name in ("episode", "length", "success"):
            assert (found[name].to_numpy() == ended[name]).all(), name
        assert (found["return_taxi_2"].to_numpy() == ended["returns"][:, 1]).all()
    assert_measures(taxis, metrics)


def assert_measures(run, metrics):
    with open_recording(run.recording) as recording:
        expected = [
            (found.phase, found.step, found.episode, name, value)
            for found in measures(recording)
            for name, value in found.values.items()
        ]
        (last,) = recording.eval.all_metrics()[-1:]
        (exact,) = list(recording.table(schema.OPTIMALITY_TOPIC).decoded())[-1:]
    assert (
        list(zip(*(metrics[c] for c in ("phase", "step", "episode", "metric", "value")), strict=True))
        == expected
    )
    named = {
        name: value for phase, step, _, name, value in expected if (phase, step) == ("eval", last["step"])
    }
    assert named["success_percent"] == last["success_percent"]
    assert named["mean_return/taxi_2"] == last["mean_returns"][1]
    assert named["training/percent_filled/taxi_1"] == last["percent_filled"][0]
    assert named["exact/value/taxi_1"] == exact["values"][0]
    assert named["exact/optimal_mean_length"] == exact["optimal_mean_length"]
    assert named["events/taxi_1.drop_off"] + named["events/taxi_2.drop_off"] == last["successes"]


@pytest.mark.parametrize("form", ["csv", "parquet", "minari"])
@pytest.mark.parametrize("ranges", ["9999:", "0:9999", "5:3"])
def test_missing_episodes_are_refused(export, taxis, form, ranges):
    errors = export(form, taxis.recording, "--episodes", ranges, code=2).stderr
    assert "found no training episodes" in errors
    assert "Ranges are of whole episodes: START..STOP, STOP not included." in " ".join(errors.split())
    assert not [path for path in Path().rglob("*") if path.is_file()]


def test_tables_of_chosen_episodes(export, taxis):
    export("csv", taxis.recording, "-o", "out", "--episodes", "3:5,58:")
    steps = read_table(Path("out/steps.csv")).to_pandas()
    assert set(steps["phase"]) == {"train"}
    assert sorted(set(steps["episode"])) == [3, 4, 58, 59]
    export("csv", taxis.recording, "-o", "out", "--phase", "eval", "--force")
    assert set(read_table(Path("out/episodes.csv")).to_pandas()["phase"]) == {"eval"}


@pytest.mark.parametrize("phase", ["train", "eval"])
def test_minari_reads_the_episodes(export, taxis, phase, monkeypatch):
    import minari

    monkeypatch.setattr("runner.export.minari._BATCH", 7)
    result = export("minari", taxis.recording, "--phase", phase)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(Path("exports/minari").absolute()))
    dataset = minari.load_dataset(f"taxis-{taxis.run_id}-v0")
    recorded = steps_of(taxis.recording, phase)
    with open_recording(taxis.recording) as recording:
        ended = recording.phase(phase).episodes.array()
        mdp = recording.mdp
    assert dataset.total_episodes == len(ended)
    assert dataset.total_steps == len(recorded)
    assert (dataset.observation_space.n, dataset.action_space.n) == (mdp.states, mdp.joint_actions)
    assert "specify" not in result.stderr
    assert dataset.spec.env_spec.id == "DualTaxi-v1"
    for episode, record in zip(dataset.iterate_episodes(), ended, strict=True):
        steps = recorded[recorded["episode"] == record["episode"]]
        assert episode.observations.tolist() == [*steps["state"].tolist(), int(steps["next_state"][-1])]
        assert (episode.actions == steps["action"]).all()
        assert (episode.rewards == steps["rewards"].sum(axis=1)).all()
        assert (episode.terminations == steps["terminated"]).all()
        assert (episode.truncations == steps["truncated"]).all()
        assert (episode.infos["rewards"][1:] == steps["rewards"]).all()


def test_minari_of_chosen_and_of_cut_off_episodes(export, taxis, killed, monkeypatch):
    import minari

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(Path("exports/minari").absolute()))
    export("minari", taxis.recording, "--episodes", "7")
    assert minari.load_dataset(f"taxis-{taxis.run_id}-v0").total_steps == len(
        steps_of(taxis.recording, "train", 7, 8)
    )
    result = export("minari", killed, "--force")
    assert "interrupted" in result.stderr
    for episode in minari.load_dataset(f"taxis-{taxis.run_id}-v0").iterate_episodes():
        assert episode.terminations[-1] or episode.truncations[-1]
    assert "there are 60" in export("minari", taxis.recording, "--episodes", "60:", "--force", code=2).stderr


def test_tensorboard_reads_the_measures(export, taxis):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from tensorboard.backend.event_processing import event_accumulator as accumulator
    export("tensorboard", taxis.recording, "-o", "a/logs")
    export("tensorboard", taxis.recording, "-o", "b/logs")
    (first,), (second,) = (list(Path(place, "logs").iterdir()) for place in "ab")
    assert first.name == second.name
    assert first.read_bytes() == second.read_bytes()
    events = accumulator.EventAccumulator("a/logs", size_guidance={"scalars": 0, "tensors": 0}).Reload()
    expected: dict[str, list[tuple[float, int, float]]] = {}
    with open_recording(taxis.recording) as recording:
        began, clock = taxis.created.timestamp(), read_clock(recording)
        for found in measures(recording):
            for name, value in found.values.items():
                at = began + float(np.interp(found.position, clock.positions, clock.seconds))
                expected.setdefault(f"{found.phase}/{name}", []).append((at, found.step, np.float32(value)))
        episodes = recording.train.episodes.array()
    for tag, points in expected.items():
        assert [(e.wall_time, e.step, e.value) for e in events.Scalars(tag)] == points
    returns = events.Scalars("train/episode/return/taxi_2")
    assert [event.value for event in returns] == episodes["returns"][:, 1].tolist()
    assert [event.step for event in returns] == (episodes["last_step"] + 1).tolist()
    assert set(events.Tags()["scalars"]) - set(expected) == {
        "train/episode/length",
        "train/episode/return/taxi_1",
        "train/episode/return/taxi_2",
    }


def test_the_error_for_a_loop_without_steps_does_not_suggest_rerecording(export, tmp_path):
    with runner.record(gymnasium.make("CartPole-v1"), tmp_path / "loops") as env:
        env.reset(seed=0)
    errors = export("csv", env.run.recording, code=2).stderr
    assert "found no steps to export" in errors
    assert "rerecord" not in errors


@pytest.mark.parametrize("form", ["csv", "parquet", "minari"])
def test_the_error_for_a_run_without_steps_names_the_command_that_records_them(export, bare, form):
    assert "rerecord" in export(form, bare.recording, code=2).stderr
    assert list(Path().iterdir()) in ([], [Path("exports")])


@pytest.mark.parametrize("form", ["csv", "parquet", "tensorboard"])
def test_an_interrupted_run_is_exported_as_far_as_recorded(export, killed, form):
    assert "interrupted" in export(form, killed, "-o", "out").stderr
    if form != "tensorboard":
        steps = read_table(Path(f"out/steps.{form}")).to_pandas()
        recorded = steps_of(killed, "train")
        assert (steps[steps["phase"] == "train"]["state"].to_numpy() == recorded["state"]).all()


@pytest.mark.parametrize("form", ["csv", "parquet", "tensorboard"])
def test_a_folder_is_replaced_only_by_force_and_only_if_an_export_wrote_it(export, taxis, form):
    export(form, taxis.recording, "-o", "out")
    before = sorted(Path("out").iterdir())
    assert "--force" in export(form, taxis.recording, "-o", "out", code=2).stderr
    export(form, taxis.recording, "-o", "out", "--force")
    assert sorted(Path("out").iterdir()) == before
    Path("out/mine.txt").write_text("mine")
    assert "mine.txt" in export(form, taxis.recording, "-o", "out", "--force", code=2).stderr
    assert Path("out/mine.txt").read_text() == "mine"
    assert [path.name for path in Path().iterdir()] == ["out"]


def test_the_layout_for_foxglove_names_what_a_recording_has(taxis):
    layout = json.loads((Path(__file__).parents[3] / "docs" / "foxglove-layout.json").read_text())
    panels = set()

    def walk(node):
        panels.update({node} if isinstance(node, str) else ())
        for part in (node["first"], node["second"]) if isinstance(node, dict) else ():
            walk(part)

    walk(layout["layout"])
    assert panels == set(layout["configById"])
    topics = {topic.name: topic for topic in schema.JOB_TOPICS}
    with open_recording(taxis.recording) as recording:
        for panel in layout["configById"].values():
            for path in panel.get("paths", []):
                name, _, field = path["value"].partition(".")
                topic = topics[name]
                field, _, index = field.partition("[")
                (described,) = (one for one in topic.message.fields if one.stored_name == field)
                assert bool(index) == described.repeated, path
                assert recording.table(topic).count()
            if "topicToRender" in panel:
                assert panel["topicToRender"] in topics


@pytest.mark.parametrize(
    ("form", "package", "extra"),
    [
        ("csv", "pyarrow", "archive"),
        ("minari", "minari", "minari"),
        ("minari", "h5py", "minari"),
        ("tensorboard", "tensorboardX", "tensorboard"),
    ],
)
def test_a_missing_package_is_reported_with_its_extra(export, taxis, monkeypatch, form, package, extra):
    monkeypatch.setitem(sys.modules, package, None)
    assert f"[{extra}]" in export(form, taxis.recording, code=2).stderr
