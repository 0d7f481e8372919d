"""The scene: enough to draw any state without knowing the rules."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualtaxi import DualTaxiEnv

ENV = DualTaxiEnv()


def test_the_published_map_as_a_scene():
    assert ENV.scene == {
        "rows": 4,
        "columns": 4,
        "walls": [[[0, 1], [0, 2]], [[1, 1], [1, 2]], [[2, 0], [2, 1]], [[3, 1], [3, 2]]],
        "landmarks": [
            {"name": "R", "cell": [0, 0], "colour": "#D55E00"},
            {"name": "G", "cell": [0, 3], "colour": "#009E73"},
            {"name": "Y", "cell": [3, 0], "colour": "#F0E442"},
            {"name": "B", "cell": [3, 2], "colour": "#0072B2"},
        ],
        "things": [
            {"name": "taxi_1", "label": "taxi 1", "kind": "mover", "agent": "taxi_1"},
            {"name": "taxi_2", "label": "taxi 2", "kind": "mover", "agent": "taxi_2"},
            {"name": "passenger", "label": "passenger", "kind": "passenger"},
            {"name": "destination", "label": "destination", "kind": "goal"},
        ],
        "actions": [
            {"name": "south", "move": [1, 0]},
            {"name": "north", "move": [-1, 0]},
            {"name": "east", "move": [0, 1]},
            {"name": "west", "move": [0, -1]},
            {"name": "pickup", "move": None},
            {"name": "drop_off", "move": None},
        ],
    }


def test_a_scene_is_plain_data():
    assert json.loads(json.dumps(ENV.scene)) == ENV.scene


def test_landmarks_of_other_names_have_colours_of_their_own():
    env = DualTaxiEnv(map=["+-------+", "|A:R:C:D|", "+-------+"])
    colours = [mark["colour"] for mark in env.scene["landmarks"]]
    assert colours[1] == "#D55E00"
    assert len(set(colours)) == 4


@given(state=st.integers(0, 6143))
def test_cells_and_carriers_match_the_state(state):
    taxi_1, taxi_2, passenger, destination = ENV.decode(state)
    landmarks = [tuple(mark["cell"]) for mark in ENV.scene["landmarks"]]
    rider = passenger - 4 if passenger >= 4 else -1
    where = (taxi_1, taxi_2)[rider] if rider >= 0 else landmarks[passenger]
    cells = [divmod(int(cell), 4) for cell in ENV.scene_cells[state]]
    assert cells == [taxi_1, taxi_2, where, landmarks[destination]]
    assert ENV.scene_carriers[state].tolist() == [-1, -1, rider, -1]


def test_the_arrays_have_the_promised_shapes_and_types():
    assert (ENV.scene_cells.shape, ENV.scene_cells.dtype) == ((6144, 4), np.int16)
    assert (ENV.scene_carriers.shape, ENV.scene_carriers.dtype) == ((6144, 4), np.int8)


def test_events_have_names_for_both_taxis_and_successes_are_among_them():
    single = ("pickup", "drop_off", "wrong_stop", "illegal_pickup", "illegal_drop_off")
    both = [f"taxi_{taxi}.{event}" for event in single for taxi in (1, 2)]
    assert ENV.event_names == (*both, "collision")
    assert ENV.success_events == ("taxi_1.drop_off", "taxi_2.drop_off")
    assert ENV.penalty_below == -2.0


@pytest.mark.parametrize("row", [0, 1])
def test_cells_count_by_the_columns_of_the_map(row):
    env = DualTaxiEnv(map=["+-----+", "|A: : |", "| : :B|", "+-----+"])
    state = env.encode((row, 2), (0, 1), 3, 1)
    assert env.scene_cells[state].tolist() == [row * 3 + 2, 1, 1, 5]
