"""Games in turns: recorded as they are played, step for step, and done again."""

from __future__ import annotations

import json
import sys
from functools import partial
from typing import Any

import numpy as np
import pytest

import runner
from runner.analysis.diff import diff
from runner.errors import ConfigError
from runner.execution.verify import check_integrity, verify
from runner.export.pictures import Pictures, PictureSource
from runner.recording.reader import open_recording
from tests.runner.loops.making import dualtaxi

tictactoe = pytest.importorskip("pettingzoo.classic.tictactoe_v3")
mpe = pytest.importorskip("mpe2.simple_spread_v3")
with pytest.MonkeyPatch.context() as patch:
    # This module turns it off for good: pytest would compile all test modules that follow, each time.
    patch.setattr(sys, "dont_write_bytecode", sys.dont_write_bytecode)
    cooperative = pytest.importorskip("pettingzoo.butterfly.knights_archers_zombies_v11")

GAMES = {
    "tictactoe": tictactoe.env,
    "spread": partial(mpe.env, max_cycles=5),
    "knights": partial(cooperative.env, max_cycles=60),
}


def play(env: Any, games: int, rng: np.random.Generator, is_seeded: bool = True) -> list[dict[str, float]]:
    """Play games as PettingZoo's documentation has it; return what each agent got by `last`, by game."""
    sums = []
    for game in range(games):
        env.reset(seed=game if is_seeded else None)
        total = dict.fromkeys(env.possible_agents, 0.0)
        for agent in env.agent_iter():
            observation, reward, terminated, truncated, _ = env.last()
            total[agent] += reward
            if terminated or truncated:
                env.step(None)
                continue
            is_masked = isinstance(observation, dict) and "action_mask" in observation
            mask = np.asarray(observation["action_mask"] if is_masked else np.ones(env.action_space(agent).n))
            env.step(int(rng.choice(np.flatnonzero(mask))))
        sums.append(total)
    return sums


@pytest.mark.parametrize(
    ("name", "is_seeded"), [*((name, True) for name in GAMES), ("spread", False), ("knights", False)]
)
def test_a_game_in_turns_comes_out_again(name, is_seeded, tmp_path):
    with runner.record_aec(GAMES[name](), tmp_path, name=name) as rec:
        got = play(rec, 3, np.random.default_rng(5), is_seeded)
    check_integrity(rec.run.recording)
    with open_recording(rec.run.recording) as recording:
        episodes = recording.train.episodes.array()
        steps = list(recording.train.transitions())
        assert recording.maker.spec
    assert len(episodes) == 3
    for episode, total in zip(episodes, got, strict=True):
        np.testing.assert_allclose(episode["returns"], list(total.values()))
    assert all(int(step["acted"]).bit_count() == 1 for step in steps)
    found = verify(rec.run.recording)
    assert (found.verdict, found.episodes, found.steps) == ("reproduced", 3, len(steps))


def test_the_loop_takes_the_same_steps_as_without_recording(tmp_path):
    with runner.record_aec(tictactoe.env(), tmp_path) as rec:
        got = play(rec, 5, np.random.default_rng(1))
    assert got == play(tictactoe.env(), 5, np.random.default_rng(1))


def test_steps_are_those_of_one_agent_with_what_all_can_observe(tmp_path):
    with runner.record_aec(tictactoe.env(), tmp_path, info=["*"]) as rec:
        rec.reset(seed=0)
        for action in (0, 3, 1, 4, 2):  # the first player wins
            agent = rec.agent_selection
            rec.step(action, extras={agent: {"value": 0.5}})
            rec.note_step({agent: {"late": 1.0}})
        assert rec.terminations == {"player_1": True, "player_2": True}
        rec.step(None)
        rec.step(None)
        assert rec.agents == []
    with open_recording(rec.run.recording) as recording:
        steps = list(recording.train.transitions())
        assert [int(step["acted"]) for step in steps] == [1, 2, 1, 2, 1]
        assert [step["rewards"].tolist() for step in steps][-2:] == [[0, 0], [1, -1]]
        assert (steps[-1]["agents_terminated"], steps[-1]["terminated"]) == (3, True)
        first = steps[0]["next_observation"]
        assert first["player_1"]["observation"][0, 0].tolist() == [1, 0]
        assert first["player_2"]["observation"][0, 0].tolist() == [0, 1]
        assert first["player_2"]["action_mask"].tolist() == [0, *[1] * 8]
        assert set(recording.train.extras) == {
            f"player_{k}/{name}" for k in (1, 2) for name in ("value", "late")
        }


def test_pages_films_and_diffs_show_games_in_turns(tmp_path):
    runs = []
    for seed in (1, 2):
        with runner.record_aec(tictactoe.env(), tmp_path, name=f"game{seed}") as rec:
            play(rec, 2, np.random.default_rng(seed))
        runs.append(rec.run)
    with open_recording(runs[0].recording) as a, open_recording(runs[1].recording) as b:
        shown = Pictures(a, "train", 0)
        assert shown.source is PictureSource.REDRAWN
        assert [picture.action[:8] for picture in shown][1:3] == ["player 1", "player 2"]
        found = diff(a, b).divergence
        assert (found.episode, found.t, found.field) == (0, 0, "action.player_1")
    played = dualtaxi(tmp_path, "play", "game1", "--json").stdout.splitlines()
    assert [json.loads(line)["acted"] for line in played[:2]] == [["player_1"], ["player_2"]]
    dualtaxi(tmp_path, "report", "game1", "-o", str(tmp_path / "page.html"))
    assert "player_2" in (tmp_path / "page.html").read_text()


def test_a_branch_of_a_game_in_turns(tmp_path):
    with runner.record_aec(tictactoe.env(), tmp_path) as rec:
        rec.reset(seed=0)
        for action in (0, 3, 1, 4, 2):
            rec.step(action)
    branch = runner.branch(rec.run, at="0:3", action="player_2=2", policy="random", recordings=tmp_path)
    with open_recording(branch.run.recording) as recording:
        actions = [int(step["action"][f"player_{step['acted']}"]) for step in recording.train.transitions()]
    assert actions[:4] == [0, 3, 1, 2]
    with pytest.raises(ConfigError, match="an agent that acts at this step: player_2"):
        runner.branch(rec.run, at="0:3", action="player_1=2", recordings=tmp_path)


def test_another_kind_of_environment_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="expected a game in turns"):
        runner.record_aec(mpe.parallel_env(), tmp_path)
    with pytest.raises(ConfigError, match="record_aec records games in turns"):
        runner.record_parallel(tictactoe.env(), tmp_path)
