"""Episodes counted in blocks, against the same rules applied step by step and environment by environment."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from runner.recording.episode_log import EpisodeLog, TurnBlock

AGENTS = 2


@st.composite
def phases(draw):
    """Return the steps of a phase, [rows, environments], and the rows at which blocks are cut."""
    shape = draw(st.integers(1, 20)), draw(st.integers(1, 3))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    terminated, truncated, reset, over = (
        rng.random(shape) < draw(st.sampled_from([0, 0.1, 0.5])) for _ in range(4)
    )
    only_reset = np.zeros(shape, bool)
    if draw(st.booleans()):  # the environments ignore the action after the end of an episode
        for row in range(1, shape[0]):
            only_reset[row] = (terminated | truncated | over)[row - 1] & ~reset[row]
            for flags in (terminated, truncated, over):
                flags[row] &= ~only_reset[row]
    rewards = rng.integers(-3, 4, (*shape, AGENTS)).astype(float)
    cuts = sorted(draw(st.sets(st.integers(1, shape[0]))) | {shape[0]})
    return rewards, terminated, truncated, reset | only_reset, only_reset, over, cuts


@settings(deadline=None)
@given(phases())
def test_blocks_of_steps_have_the_episodes_of_single_steps(phase):
    rewards, terminated, truncated, reset, only_reset, over, cuts = phase
    rows, n = terminated.shape
    places, ended = [], []
    episode, length, returns = [0] * n, [0] * n, [np.zeros(AGENTS) for _ in range(n)]

    def end(i, row, by_reset):
        flags = (False, False) if by_reset else (terminated[row, i], truncated[row, i])
        last = row - by_reset
        first = last * n + i - (length[i] - 1) * n
        ended.append(((last, by_reset, i), i, first, last * n + i, length[i], *returns[i], *flags))
        episode[i], length[i], returns[i] = episode[i] + 1, 0, np.zeros(AGENTS)

    for row in range(rows):
        for i in range(n):
            if reset[row, i] and length[i]:
                end(i, row, by_reset=True)
            places.append((0 if only_reset[row, i] else length[i], episode[i]))
            if not only_reset[row, i]:
                length[i] += 1
                returns[i] = returns[i] + rewards[row, i]
            if terminated[row, i] or truncated[row, i] or over[row, i]:
                end(i, row, by_reset=False)

    log, found_places, found_ended = EpisodeLog(n, AGENTS, None, has_turns=True), [], []
    for begin, stop in zip([0, *cuts], cuts, strict=False):
        columns = (each[begin:stop] for each in (rewards, terminated, truncated, reset, only_reset, over))
        block = log.take(TurnBlock(begin * n, *columns))
        found_places += zip(block.t.ravel(), block.number.ravel(), strict=True)
        names = ("environment", "first_step", "last_step", "length", "returns", "terminated", "truncated")
        fields = [block.ended[name] for name in names]
        found_ended += [
            (*place, size, *sums, ends, cut) for *place, size, sums, ends, cut in zip(*fields, strict=True)
        ]
    assert found_places == places
    assert found_ended == [tuple(fields) for _, *fields in sorted(ended, key=lambda one: one[0])]
    assert (log.episode.tolist(), log.length.tolist(), log.ended) == (episode, length, len(ended))
