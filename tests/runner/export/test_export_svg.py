"""The grid as SVG: well-formed, everything at its place, the same in film and page."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import numpy as np
import pytest

from runner.drawing import palette, svg, svg_maps
from runner.drawing.svg import CELL, MARGIN, SvgDrawing
from runner.export.reports.maps import maps_of, situation, stages_of
from runner.recording.reader import open_recording

NS = {"s": "http://www.w3.org/2000/svg"}


@pytest.fixture
def scene(recording):
    if recording.mdp.scene is None:
        pytest.skip("no scene")
    return recording.mdp


def test_a_frame_is_svg_with_all_cells_walls_landmarks_and_things(scene):
    drawing = SvgDrawing(scene.scene)
    places = drawing.places(scene, np.arange(4))
    root = ElementTree.fromstring(drawing.frame(places[3], 'a "title" & <more>', places))
    assert root.get("aria-label") == 'a "title" & <more>'
    classes = [element.get("class") for element in root.iter()]
    assert classes.count("g-cell") == scene.scene["rows"] * scene.scene["columns"]
    assert classes.count("g-wall") == len(scene.scene["walls"])
    assert classes.count("g-letter") == len(scene.scene["landmarks"])
    numbers = {int(group.get("data-thing")) for group in root.iterfind(".//s:g[@data-thing]", NS)}
    assert numbers == set(range(len(scene.scene["things"])))


def test_things_are_drawn_in_their_cells_and_passengers_on_what_carries_them(scene):
    drawing, states = SvgDrawing(scene.scene), np.arange(scene.states)
    places = drawing.places(scene, states)
    columns = scene.scene["columns"]
    for number, _ in enumerate(scene.scene["things"]):
        x, y, size = places[:, number].astype(int).T
        found = (y - MARGIN) // CELL * columns + (x - MARGIN) // CELL
        assert (found == scene.scene_cells[:, number]).all()
        carried = scene.scene_carriers[:, number] >= 0
        assert (size[carried] < 100).all()
        assert (size[~carried] == 100).all()
        for state in np.flatnonzero(carried)[:50]:
            by = scene.scene_carriers[state, number]
            assert abs(places[state, by, :2] - places[state, number, :2]).max() <= 25


def test_no_two_movers_are_drawn_on_top_of_each_other(pictured):
    from runner.recording.reader import open_recording

    with open_recording(pictured("taxis").recording) as opened:
        mdp = opened.mdp
    places = SvgDrawing(mdp.scene).places(mdp, np.arange(mdp.states))
    assert (places[:, 0, :2] != places[:, 1, :2]).any(axis=1).all()


def test_the_key_names_everything(scene):
    key = SvgDrawing(scene.scene).key()
    assert key[0].isupper()
    assert key.endswith(".")
    assert all(thing["label"] in key for thing in scene.scene["things"])
    assert ("walls" in key) == bool(scene.scene["walls"])


def test_maps_are_svg_at_every_stage_with_arrows_after_learning(scene, recording):
    learners = recording.agents
    stages = stages_of(recording)
    assert [stage.episode for stage in stages] == [0, 20, 40]
    rows = maps_of(scene, learners, stages, int(scene.start.argmax()))
    movers = sum(thing["kind"] == "mover" for thing in scene.scene["things"])
    assert len(rows) == movers + (len(learners) if movers == 2 else 0)
    for row in rows:
        assert row.ramp[0] <= row.ramp[1]
        roots = [ElementTree.fromstring(figure.picture) for figure in row.figures]
        arrows = [sum(e.get("class") == "m-arrow" for e in root.iter()) for root in roots]
        assert arrows[0] == 0
        assert arrows[-1] > 0 or recording.run["name"] not in ("taxi", "cliff")


def test_an_arrow_points_to_the_action_of_the_highest_value(pictured):
    from runner.recording.reader import open_recording

    with open_recording(pictured("cliff").recording) as opened:
        mdp, stage = opened.mdp, stages_of(opened)[-1]
        (row,) = maps_of(mdp, opened.agents, [stage], 36)
    picture = row.figures[0].picture
    table = stage.tables[0]
    angles = {"up": 0, "right": 90, "down": 180, "left": 270}
    names = [action["name"] for action in mdp.scene["actions"]]
    for x, y, angle in re.findall(r"translate\((\d+) (\d+)\) rotate\((\d+)\)", picture):
        cell = (int(y) - MARGIN) // CELL * 12 + (int(x) - MARGIN) // CELL
        assert angles[names[table[cell].argmax()]] == int(angle)


def test_a_situation_is_all_places_of_the_free_things_and_nothing_else(pictured):
    from runner.recording.reader import open_recording

    with open_recording(pictured("taxis").recording) as opened:
        mdp = opened.mdp
    start = int(np.flatnonzero(mdp.start)[0])
    assert situation(mdp, start, [0, 1]).sum() == 16 * 16
    assert situation(mdp, start, [0]).sum() == 16


def test_colours_go_from_dark_to_light_and_nan_is_none():
    assert palette.ramp_colour(0) == palette.RAMP[0]
    assert palette.ramp_colour(palette.LEVELS - 1) == palette.RAMP[-1]
    lightness = [int(palette.ramp_colour(i)[3:5], 16) for i in range(palette.LEVELS)]
    assert lightness == sorted(lightness)
    assert svg_maps.levels_of(np.array([0.0, 5.0, 10.0, np.nan]), 0, 10).tolist() == [0, 16, 31, -1]
    assert svg_maps.levels_of(np.array([3.0]), 3, 3).tolist() == [0]


def test_a_trail_is_the_last_places():
    places = np.array([[n, 2 * n, 100] for n in range(100)], np.int16)
    points = svg.trail_points(places).split()
    assert len(points) == svg.TRAIL
    assert points[-1] == "99,198"


def test_only_a_snapshot_near_half_of_the_episodes_is_called_the_middle(pictured):
    for every, title in ((10, "in the middle: 20 episodes"), (15, "during learning: 15 episodes")):
        with open_recording(pictured("lake", snapshots={"every": every}).recording) as opened:
            assert [stage.title for stage in stages_of(opened)][1] == title


def test_text_on_every_colour_of_values_can_be_read():
    def luminance(colour):
        linear = [
            part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4
            for part in (channel / 255 for channel in palette.rgb(colour))
        ]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    for level in range(palette.LEVELS):
        colour = palette.ramp_colour(level)
        dark, light = sorted(luminance(each) for each in (colour, palette.ink_on(colour)))
        assert (light + 0.05) / (dark + 0.05) >= 4.5
