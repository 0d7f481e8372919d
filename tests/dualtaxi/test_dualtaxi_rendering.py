"""States as text, with and without colour, and as pictures."""

from __future__ import annotations

import re

import numpy as np
import pytest
from gymnasium.utils import colorize
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dualtaxi import DualTaxiEnv

SOUTH, NORTH, EAST, WEST, PICKUP, DROP_OFF = range(6)
MAPS = [None, ["+-+", "|Q|", "| |", "|Z|", "+-+"], ["+---------+", "|A:B:C:D:E|", "+---------+"]]
TEXT = DualTaxiEnv("ansi")
PICTURES = [DualTaxiEnv("rgb_array", map=text) for text in MAPS]


def show(env: DualTaxiEnv, state: int, actions: tuple[int, int] | None = None):
    env.reset(seed=0)
    env.s, env.last_actions = state, actions
    return env.render()


@pytest.fixture
def in_colour(monkeypatch):
    monkeypatch.delenv("NO_COLOR", raising=False)


@pytest.fixture
def in_letters(monkeypatch):
    monkeypatch.setenv("NO_COLOR", "1")


def test_colours_mark_taxis_passenger_and_destination(in_colour):
    text = show(TEXT, TEXT.encode((1, 1), (2, 2), 0, 1), (SOUTH, DROP_OFF))
    assert colorize("1", "yellow", highlight=True) in text
    assert colorize("2", "red", highlight=True) in text
    assert colorize("R", "blue", bold=True) in text
    assert colorize("G", "magenta") in text
    assert "\x1b[42m" not in text
    assert text.splitlines()[-1] == "taxi 1: south, taxi 2: drop-off"


@pytest.mark.parametrize(("passenger", "other"), [(4, "\x1b[41m2"), (5, "\x1b[43m1")])
def test_the_taxi_with_the_passenger_is_green(in_colour, passenger, other):
    text = show(TEXT, TEXT.encode((1, 1), (2, 2), passenger, 1))
    assert text.count("\x1b[42m") == 1
    assert f"\x1b[42m{passenger - 3}" in text
    assert other in text
    assert "\x1b[34;1m" not in text


def test_without_colour_codes_the_coloured_text_is_the_map(in_colour):
    text = show(TEXT, TEXT.encode((1, 1), (2, 2), 0, 1))
    plain = re.sub(r"\x1b\[[0-9;]*m", "", text)
    assert plain == "+-------+\n|R: | :G|\n| :1| : |\n| | :2: |\n|Y: |B: |\n+-------+\n\n"


def test_letters_say_all_that_colours_say(in_letters):
    text = show(TEXT, TEXT.encode((0, 0), (2, 2), 0, 1), (SOUTH, PICKUP))
    assert text.splitlines() == [
        "+-----------------------+",
        "|R 1 p:     |     :G*   |",
        "|     :     |     :     |",
        "|     |     :   2 :     |",
        "|Y    :     |B    :     |",
        "+-----------------------+",
        "passenger: waits at R, destination: G",
        "taxi 1: south, taxi 2: pickup",
        "1 2 taxis, p passenger waiting, P passenger in the taxi, * destination",
    ]


@pytest.mark.parametrize(
    ("taxi_1", "passenger", "cell", "words"),
    [
        ((0, 3), 4, "|G*1 P|", "in taxi 1"),
        ((0, 2), 5, "|B  2P:", "in taxi 2"),
        ((0, 2), 1, ":G*  p|", "arrived"),
    ],
)
def test_letters_show_where_the_passenger_is(in_letters, taxi_1, passenger, cell, words):
    text = show(TEXT, TEXT.encode(taxi_1, (3, 2), passenger, 1))
    assert cell.strip("|:") in text
    assert f"passenger: {words}, destination: G" in text
    assert "\x1b" not in text


def test_an_empty_no_color_does_not_count(monkeypatch):
    monkeypatch.setenv("NO_COLOR", "")
    assert "\x1b[43m" in show(TEXT, 1)


@given(state=st.integers(0, 6143), actions=st.none() | st.tuples(st.integers(0, 5), st.integers(0, 5)))
@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
def test_letters_show_every_state_and_no_two_alike(in_letters, state, actions):
    assert show(TEXT, state, actions) != show(TEXT, (state + 1) % 6144, actions)


@pytest.mark.parametrize("env", PICTURES, ids=["published", "one column", "one row"])
@given(data=st.data())
@settings(max_examples=15, deadline=None)
def test_any_state_has_a_picture_of_one_size(env, data):
    state = data.draw(st.integers(0, int(env.observation_space.n) - 1))
    actions = data.draw(st.none() | st.tuples(st.integers(0, 5), st.integers(0, 5)))
    picture = show(env, state, actions)
    assert picture.dtype == np.uint8
    assert picture.shape == show(env, 0).shape
    assert picture.shape[2] == 3
    assert picture.std() > 10


@pytest.mark.parametrize(
    "change",
    [
        {"taxi_1": (1, 0)},
        {"taxi_2": (3, 3)},
        {"passenger": 1},
        {"passenger": 4},
        {"passenger": 5},
        {"destination": 3},
    ],
    ids=str,
)
def test_pictures_differ_by_all_that_a_state_holds(change):
    env = PICTURES[0]
    state = {"taxi_1": (1, 1), "taxi_2": (2, 2), "passenger": 0, "destination": 2}
    assert (show(env, env.encode(**state)) != show(env, env.encode(**state | change))).sum() > 500


def test_a_passenger_aboard_is_seen_in_the_taxi():
    env = PICTURES[0]

    def ink_around(passenger: int, place: tuple[int, int]) -> int:
        picture = show(env, env.encode((1, 1), (2, 2), passenger, 2))
        quarter = picture.shape[1] // 4
        row, column = place[0] * quarter, place[1] * quarter
        return int((picture[row : row + quarter, column : column + quarter] < 60).all(axis=2).sum())

    for passenger, place, other in ((4, (1, 1), (2, 2)), (5, (2, 2), (1, 1))):
        assert ink_around(passenger, place) > ink_around(0, place) + 100
        assert ink_around(passenger, other) == ink_around(0, other)


def test_a_new_episode_shows_no_actions_of_the_last(in_colour):
    TEXT.reset(seed=0)
    TEXT.step(0)
    assert "taxi 1: south" in TEXT.render()
    TEXT.reset()
    assert "taxi 1" not in TEXT.render()


def test_pictures_show_the_last_actions():
    env = PICTURES[0]
    assert not np.array_equal(show(env, 1, (SOUTH, SOUTH)), show(env, 1, (SOUTH, DROP_OFF)))


def test_drawing_leaves_the_next_picture_clean():
    env = PICTURES[0]
    first = show(env, 100)
    show(env, 5000, (WEST, PICKUP))
    assert np.array_equal(show(env, 100), first)


def test_a_taxi_is_drawn_in_its_cell_in_its_colour():
    env = PICTURES[0]
    orange, blue = (0xE6, 0x9F, 0x00), (0x56, 0xB4, 0xE9)
    for place_1, place_2 in (((0, 1), (3, 3)), ((3, 1), (0, 2))):
        picture = show(env, env.encode(place_1, place_2, 2, 1))
        picture = picture[: picture.shape[1]]  # the map without the lines below it
        for place, colour in ((place_1, orange), (place_2, blue)):
            rows, columns = np.nonzero((picture == colour).all(axis=2))
            quarter = picture.shape[1] / 4
            assert (int(np.median(rows) // quarter), int(np.median(columns) // quarter)) == place


def test_rendering_without_a_mode_warns_and_shows_nothing():
    env = DualTaxiEnv()
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="render_mode"):
        assert env.render() is None
