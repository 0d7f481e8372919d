"""An export, read back and compared with the recording step by step."""

from __future__ import annotations

import shutil
import subprocess

import numpy as np
import pytest
import rerun as rr
from rerun.chunk import RrdReader

import runner
from runner.environments.mdp import events_of
from runner.export.rerun.scene import GridLabels, scene_of
from runner.export.rerun.selection import Request
from runner.export.rerun.tracks import PLOTS
from runner.export.rerun.viewer import viewer_program
from runner.export.rerun.writing import export
from runner.recording import schema
from runner.recording.reader import open_recording
from runner.replay.tables import TableReplay, tables_at
from runner.runs.resolve import find_run
from runner.runs.run import run_at
from tests.runner.altering import without_chunk
from tests.runner.export.rerun_views import views_of
from tests.runner.recording.making import TAXIS, make_run

TOPICS = {"train": schema.TRAIN_STEP, "eval": schema.EVAL_STEP}


class Exported:
    """A whole run, exported and read back."""

    def __init__(self, recording, path):
        self.recording = recording
        self.path = path
        (self.selection,) = export([run_at(recording.path)], Request(everything=True), path)
        self.store = RrdReader(str(path)).store()

    def table(self, entity, component=None):
        """Return the columns of an entity's rows that have times and the component, in order of the step."""
        chunks = self.store.stream().filter(content=entity).to_chunks()
        batches = [chunk.to_record_batch() for chunk in chunks if not chunk.is_static]
        batches = [batch for batch in batches if "Clear:is_recursive" not in batch.schema.names]
        batches = [batch for batch in batches if component is None or component in batch.schema.names]
        names = [name for name in batches[0].schema.names if not name.startswith("rerun.")]
        columns = {
            name: [cell for batch in batches for cell in batch.column(name).to_pylist()] for name in names
        }
        order = np.argsort(columns["step"], kind="stable")
        return {name: [values[i] for i in order] for name, values in columns.items()}

    def steps(self, phase):
        """Return the recorded steps of a phase."""
        return self.recording.table(TOPICS[phase]).array()


@pytest.fixture(scope="module", params=["taxis", "rivals", "taxi", "lake", "cliff", "corridor"])
def exported(request, pictured, tmp_path_factory):
    with open_recording(pictured(request.param).recording) as recording:
        yield Exported(recording, tmp_path_factory.mktemp("rerun") / "run.rrd")


def seen_values(recording, phase, steps):
    """Return the values that the learners saw at each step, [n, learners, most actions], from a replay."""
    if phase == "train":
        return TableReplay(recording, 0).rows(len(steps))
    trained = steps["log_time"].astype(np.int64) // schema.STEP_NANOSECONDS - steps["step"] - 1
    tables = {step: tables_at(recording, int(step)) for step in np.unique(trained)}
    return np.array(
        [
            [table[state] for table in tables[step]]
            for step, state in zip(trained, steps["state"], strict=True)
        ]
    )


@pytest.mark.parametrize("phase", TOPICS)
class TestSteps:
    """Every step of a phase."""

    def test_every_step_is_there_at_its_time(self, exported, phase):
        steps, table = exported.steps(phase), exported.table(f"/{phase}/reward")
        assert table["step"] == (steps["log_time"] // schema.STEP_NANOSECONDS).tolist()
        assert table["t"] == steps["t"].tolist()
        if phase == "train":
            assert table["episode"] == steps["episode"].tolist()
        else:
            trials = exported.recording.config["evaluation"]["trials"]
            after = [row["episode"] for row in exported.recording.eval.all_metrics()]
            assert table["episode"] == [after[k // trials] for k in steps["episode"].tolist()]

    def test_rewards(self, exported, phase):
        assert (
            exported.table(f"/{phase}/reward")["Scalars:scalars"] == exported.steps(phase)["rewards"].tolist()
        )

    def test_values_are_those_of_the_step(self, exported, phase):
        steps, counts = exported.steps(phase), exported.recording.mdp.action_counts
        rows = seen_values(exported.recording, phase, steps)
        if rows.shape[1] == len(counts):
            expected = np.concatenate([rows[:, i, :count] for i, count in enumerate(counts)], axis=1)
        else:
            joint = rows[:, 0].reshape(len(steps), *counts)
            expected = np.concatenate((joint.max(axis=2), joint.max(axis=1)), axis=1)
        assert np.array_equal(exported.table(f"/{phase}/q", "Scalars:scalars")["Scalars:scalars"], expected)

    def test_positions_and_moves(self, exported, phase):
        mdp = exported.recording.mdp
        scene, steps = scene_of(mdp), exported.steps(phase)
        if scene is None:
            assert exported.table(f"/{phase}/state")["Scalars:scalars"] == [
                [s] for s in steps["state"].tolist()
            ]
            assert exported.table(f"/{phase}/action")["Scalars:scalars"] == [
                [a] for a in steps["action"].tolist()
            ]
            return
        table = exported.table(f"/{phase}/grid/things", "Points2D:positions")
        boxes = np.array(table["Boxes2D:centers"])
        points = np.array(table["Arrows2D:origins"])
        for i, mover in enumerate(scene.movers):
            cells = mdp.scene_cells[steps["state"], mover]
            for shape in [k for k, owner in enumerate(scene.owners) if owner == i]:
                inside = np.floor(boxes[:, shape]).astype(int)
                assert np.array_equal(inside[:, 1] * scene.columns + inside[:, 0], cells)
            drawn = np.floor(points[:, i]).astype(int)
            assert np.array_equal(drawn[:, 1] * scene.columns + drawn[:, 0], cells)
            tips = np.floor(points[:, i] + np.array(table["Arrows2D:vectors"])[:, i]).astype(int)
            moved = mdp.scene_cells[steps["next_state"], mover]
            went = moved != cells
            assert np.array_equal((tips[:, 1] * scene.columns + tips[:, 0])[went], moved[went])

    def test_trails_are_the_last_five_steps_of_the_episode(self, exported, phase):
        scene, steps = scene_of(exported.recording.mdp), exported.steps(phase)
        if scene is None:
            return
        strips = exported.table(f"/{phase}/grid/things", "LineStrips2D:strips")["LineStrips2D:strips"]
        for k in (0, 1, 3, 7, len(steps) - 1):
            back = [max(k - j, k - int(steps["t"][k])) for j in range(5, -1, -1)]
            expected = scene.points[steps["state"][back], : len(scene.movers)].swapaxes(0, 1)
            assert np.array_equal(np.array(strips[k], np.float32), expected)

    def test_maps_are_those_of_the_step_in_their_label(self, exported, phase):
        recording = exported.recording
        scene = scene_of(recording.mdp)
        if scene is None or scene.placements is None:
            return
        steps, pictures = exported.steps(phase), scene.placements
        time = steps["log_time"].astype(np.int64) // schema.STEP_NANOSECONDS
        for learner, name in enumerate(recording.agents):
            table = exported.table(f"/{phase}/map/{name}")
            letters = exported.table(f"/{phase}/map/{name}/stops")["Points2D:class_ids"]
            still = np.array([not any(action["move"] or ()) for action in scene.description["actions"]])
            context = pictures.context[steps["state"]]
            changed = np.append(True, context[1:] != context[:-1]) | (steps["t"] == 0)
            assert table["step"] == time[changed].tolist()
            for k in range(0, len(table["step"]), max(1, len(table["step"]) // 3)):
                step = steps[np.searchsorted(time, table["step"][k])]
                trained = int(step["step"]) if phase == "train" else table["step"][k] - int(step["step"]) - 1
                seen = tables_at(recording, trained)[learner]
                q = seen.max(axis=1)
                shown = np.array(table["DepthImage:buffer"][k][0], np.uint8).view(np.float32)
                order = pictures.order(learner if len(recording.agents) > 1 else 0)
                states = pictures.states[pictures.context[step["state"]]][order]
                assert np.array_equal(shown[states >= 0], q[states[states >= 0]].astype(np.float32))
                greedy = seen[states[states >= 0]].argmax(axis=1)
                own = greedy if len(recording.agents) > 1 else recording.mdp.own_actions[greedy]
                assert len(letters[k]) == still[own].sum()

    def test_events_are_in_the_log(self, exported, phase):
        mdp, steps = exported.recording.mdp, exported.steps(phase)
        table = exported.table(f"/{phase}/events")
        lines = [text for (text,) in table["TextLog:text"]]
        assert sum("begins:" in text for text in lines) == (steps["t"] == 0).sum()
        assert sum("time-out" in text for text in lines) == (steps["truncated"] & ~steps["terminated"]).sum()
        if "collision" in mdp.event_names:
            bit = mdp.event_names.index("collision")
            happened = events_of(mdp, steps) >> bit & 1
            assert sum(text.startswith("collision") for text in lines) == happened.sum()
        if phase == "eval":
            results = len(exported.recording.eval.all_metrics())
            assert sum(text.startswith("evaluation after") for text in lines) == results


def test_the_labels_of_movers_show_illegal_actions(exported):
    mdp, steps = exported.recording.mdp, exported.steps("train")
    scene = scene_of(mdp)
    if scene is None or "collision" not in mdp.event_names:
        return
    labels, events = GridLabels(mdp, scene, exported.recording.agents), events_of(mdp, steps)
    numbers = labels.of_steps(steps, events)
    shown = np.array([text for text, _ in labels.numbers])[numbers]
    illegal = events >> mdp.event_names.index("taxi_2.illegal_pickup") & 1
    assert [("illegal pickup" in label) for label in shown[:, 1]] == illegal.astype(bool).tolist()
    assert not any("illegal pickup" in label for label in shown[illegal == 0, 1])


def test_every_metric_is_there(exported):
    metrics = exported.recording.eval.all_metrics()
    assert exported.table("/eval/metrics/mean_length")["Scalars:scalars"] == [
        [row["eval_mean_length"]] for row in metrics
    ]
    if metrics[0]["successes"] >= 0:
        finished = [[row["success_percent"]] for row in metrics]
        assert exported.table("/eval/metrics/success_percent")["Scalars:scalars"] == finished
    names = [
        "filled_percent",
        "epsilon",
        "step_size",
        "discount",
        "mean_length",
        "mean_penalties",
        "mean_return",
    ]
    for name in [*names, "reward_percent"]:
        assert exported.table(f"/train/metrics/{name}")["Scalars:scalars"]
    lengths = [row[0] for row in exported.table("/train/episodes")["Scalars:scalars"]]
    assert lengths == exported.recording.train.episodes.array()["length"].tolist()


def test_means_between_reports_are_of_the_episodes_that_ended_there(exported):
    recording = exported.recording
    episodes = recording.train.episodes.array()
    reports = sorted(
        [*recording.train.all_metrics(), *recording.eval.all_metrics()], key=lambda row: row["log_time"]
    )
    table = exported.table("/train/metrics/mean_penalties")
    found = dict(zip(table["step"], (value for (value,) in table["Scalars:scalars"]), strict=True))
    before = 0
    for row in reports:
        ended = episodes[(episodes["last_step"] >= before) & (episodes["last_step"] < row["step"])]
        time = row["log_time"] // schema.STEP_NANOSECONDS
        if len(ended):
            assert found[time] == pytest.approx(ended["penalties"].mean())
        before = max(before, row["step"])


def test_views_show_what_was_sent(exported):
    recording, views = exported.recording, views_of(exported.path)
    scene, shown = scene_of(recording.mdp), {entity for entities in views.values() for entity in entities}
    chunks = exported.store.stream().to_chunks()
    assert shown <= {str(chunk.entity_path) for chunk in chunks}
    for phase in TOPICS:
        parts = ["state", "action"] if scene is None else ["grid/things", "grid/title"]
        assert {f"/{phase}/{part}" for part in [*parts, "q", "events"]} <= shown
    for name in recording.agents if scene and scene.placements else ():
        (view,) = [entities for entities in views.values() if f"/train/map/{name}" in entities]
        maps = {
            f"/{phase}/map/{name}{part}" for phase in TOPICS for part in ("", "/moves", "/here", "/stops")
        }
        assert {"/frame", *maps} <= set(view)


def test_rerun_verifies_the_file(exported, tmp_path):
    path = tmp_path / "some.rrd"
    export([run_at(exported.recording.path)], Request(episodes=((0, 2),), evaluations=(20,)), path)
    done = subprocess.run(
        [viewer_program(), "rrd", "verify", path],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_own_actions_combine_to_the_joint_action(exported):
    mdp = exported.recording.mdp
    assert np.array_equal(
        np.ravel_multi_index(tuple(mdp.own_actions.T), mdp.action_counts), np.arange(mdp.joint_actions)
    )


def static_parts(path):
    """Return the static components of each entity of an export that draws lines."""
    parts = {}
    for chunk in RrdReader(str(path)).store().stream().to_chunks():
        batch = chunk.to_record_batch()
        if chunk.is_static and "SeriesLines:names" in batch.schema.names:
            columns = {name: batch.column(name)[0].as_py() for name in batch.schema.names if ":" in name}
            parts[str(chunk.entity_path)] = columns
    return parts


def plots_below(root):
    """Return the entities that each view of metrics may show, below a path."""
    views = {title: [] for title in PLOTS.values()}
    for name, title in PLOTS.items():
        views[title] += [f"{root}/{phase}/metrics/{name}" for phase in TOPICS]
    return list(views.values())


def scalar_entities(path):
    chunks = RrdReader(str(path)).store().stream().to_chunks()
    return {
        str(chunk.entity_path)
        for chunk in chunks
        if not chunk.is_static and "Scalars:scalars" in chunk.to_record_batch().schema.names
    }


def check_lines(path, views):
    """Assert that no line shows an average, and that a view has no two lines of one colour."""
    lines = static_parts(path)
    assert scalar_entities(path) <= set(lines)
    minmax = rr.components.AggregationPolicy.MinMax.value
    assert all(part["SeriesLines:aggregation_policy"] == [minmax] for part in lines.values())
    for entities in views:
        colours = [
            colour for name in entities for colour in lines.get(name, {}).get("SeriesLines:colors", [])
        ]
        assert len(set(colours)) == len(colours), entities


def test_lines_show_recorded_values_each_in_its_own_colour(exported):
    check_lines(exported.path, plots_below(""))


def test_values_are_left_out_after_steps_that_were_lost(tmp_path):
    run = make_run(tmp_path, TAXIS, recording={"chunk_steps": 256}, snapshots={"every": None})
    lost = without_chunk(run.recording, schema.TRAIN_STEP, 1)
    with open_recording(run.recording) as recording:
        exported = Exported(recording, tmp_path / "run.rrd")
        times = exported.steps("train")["log_time"] // schema.STEP_NANOSECONDS
        assert exported.table("/train/reward")["step"] == times.tolist()
        assert exported.table("/train/q", "Scalars:scalars")["step"] == times[:lost].tolist()


def test_lines_of_two_runs_differ_in_colour(pictured, tmp_path):
    runs = [pictured("taxis"), pictured("rivals")]
    export(runs, Request(), tmp_path / "both.rrd")
    below = zip(*(plots_below(f"/{run.run_id}") for run in runs), strict=True)
    check_lines(tmp_path / "both.rrd", [[*first, *second] for first, second in below])


def test_marks_are_in_the_log_at_their_steps(pictured, tmp_path):
    run = pictured("lake")
    folder = shutil.copytree(run.folder, tmp_path / run.run_id)
    copied = find_run(run.run_id, folder.parent)
    runner.mark(copied, "3:1", "both stuck", tags=["stuck"])
    with open_recording(copied.recording) as recording:
        step = recording.train.episode(3).one(1)
        request = Request(everything=True)
        export([copied], request, tmp_path / "run.rrd")
    store = RrdReader(str(tmp_path / "run.rrd")).store()
    (chunk,) = [c for c in store.stream().filter(content="/marks").to_chunks() if not c.is_static]
    (row,) = chunk.to_record_batch().to_pylist()
    assert row["TextLog:text"] == ["mark 3:1 both stuck [stuck]"]
    assert row["step"] == int(step["log_time"]) // schema.STEP_NANOSECONDS
