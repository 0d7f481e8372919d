"""The table of values at each step: what actions seemed worth, the greedy one, the chosen one."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from runner.drawing import palette
from runner.environments.mdp import Mdp
from runner.environments.naming import numbered_actions, spoken
from runner.export.rerun.classes import Vocabulary
from runner.export.rerun.columns import Batch, Sender, StepValues, instances, rgba, scalars, strips
from runner.export.rerun.lines import series_lines
from runner.export.rerun.scene import own_actions

NAME_X: Final = 1.0
BAR_LEFT: Final = 2.5
BAR_LENGTH: Final = 5.0
NUMBER_X: Final = 9.4
GREEDY_X: Final = 12.2
CHOSEN_X: Final = 15.2
WIDTH: Final = 17.0
TOP: Final = -1.7
"""Columns of the table, in rows of height 1."""
LABEL_RISE: Final = 0.5
"""How much higher a point must be for its label, which is written below it, to stand in its row."""
_GAP: Final = 2.0
_FINENESS: Final = 64
"""Parts of a row's height to which the length of a bar is rounded: shorter in the file, not to be seen."""


class ValueWriter(Sender):
    """Sends the table of values of one phase; its numbers as text are rounded, its scalars are exact."""

    def __init__(
        self, stream: rr.RecordingStream, path: str, mdp: Mdp, words: Vocabulary, learners: int
    ) -> None:
        super().__init__(stream, path)
        self._words = words
        self._mdp = mdp
        self._own = own_actions(mdp)
        self._rows = bar_rows(mdp)
        agents = len(mdp.agents)
        self._explored_bit = np.arange(agents) if learners == agents else np.zeros(agents, np.int64)

    def dress(self) -> None:
        """Log sizes, colours and the names of the series."""
        counts = self._mdp.action_counts
        colours = [palette.agent(i) for i in range(len(counts))]
        bars = [rgba(colour) for colour, count in zip(colours, counts, strict=True) for _ in range(count)]
        series = [
            f"{spoken(agent)} {name}"
            for agent, names in zip(self._mdp.agents, numbered_actions(self._mdp), strict=True)
            for name in names
        ]
        self.static(
            "q",
            rr.LineStrips2D.from_fields(colors=bars, radii=0.22),
            rr.Points2D.from_fields(radii=0.0, show_labels=True, draw_order=40.0),
            series_lines(series),
        )

    def write(self, batch: Batch) -> None:
        """Send the values of each step of a batch: as they were before its update."""
        assert batch.values is not None
        values, n = batch.values.values, len(batch.records)
        columns = [
            *scalars(values),
            *instances(rr.Points2D, n, class_ids=self._classes(batch, batch.values)),
            *strips(self._bars(values)),
        ]
        self.send("q", batch.times(), columns)
        rows = batch.values.renewed  # the places are always the same, and cleared with the rest
        places = np.broadcast_to(self._places(), (len(rows), 3 * values.shape[1], 2))
        self.send("q", batch.times(rows), instances(rr.Points2D, len(rows), positions=places))

    def _places(self) -> NDArray[np.float32]:
        """Return where the number of each action is, its mark as the greedy one, and as the chosen one."""
        height = np.concatenate(self._rows) - LABEL_RISE
        columns = [
            np.stack((np.full_like(height, x), height), axis=1) for x in (NUMBER_X, GREEDY_X, CHOSEN_X)
        ]
        return np.concatenate(columns).astype(np.float32)

    def _classes(self, batch: Batch, known: StepValues) -> NDArray[np.uint16]:
        """Return the label at each of those places, by number."""
        words = self._words
        n, count = known.values.shape
        own = self._own[batch.records["action"]]
        explored = (batch.records["explored"][:, None] >> self._explored_bit & 1).astype(bool)
        classes = np.full((n, 3 * count), words.unmarked, np.uint16)
        classes[:, :count] = words.values.of(known.values)
        each, first = np.arange(n)[:, None], np.cumsum((0, *self._mdp.action_counts[:-1]))
        classes[each, count + first + known.greedy] = words.greedy
        classes[each, 2 * count + first + own] = np.where(explored, words.explored, words.chosen)
        return classes

    def _bars(self, values: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return a bar a value, [n, values, 2 points, 2]: from the agent's lowest there to its highest."""
        from runner.export.rerun import filling  # Numba is slow to load, and a live view has no values

        bars = np.empty((*values.shape, 2, 2), np.float32)
        bars[:, :, 0, 0] = BAR_LEFT
        bars[..., 1] = np.concatenate(self._rows)[:, None]
        bounds = np.cumsum((0, *self._mdp.action_counts))
        filling.bar_ends(values, bounds, BAR_LEFT, BAR_LENGTH, _FINENESS, bars[:, :, 1, 0])
        return bars


def bar_rows(mdp: Mdp) -> list[NDArray[np.float64]]:
    """Return the height of each agent's rows in the table of values, from top to bottom."""
    rows: list[NDArray[np.float64]] = []
    top = 1.0
    for count in mdp.action_counts:
        rows.append(np.arange(count, dtype=np.float64) + top)
        top += count + _GAP
    return rows


def draw_table(stream: rr.RecordingStream, path: str, mdp: Mdp) -> None:
    """Log the words around the table of values."""
    places: list[tuple[float, float]] = []
    labels: list[str] = []
    colours: list[Any] = []
    for i, (agent, rows, names) in enumerate(
        zip(mdp.agents, bar_rows(mdp), numbered_actions(mdp), strict=True)
    ):
        labels += [spoken(agent).upper(), *names]
        places += [(NAME_X, float(y) - LABEL_RISE) for y in (rows[0] - 1.15, *rows)]
        colours += [rgba(palette.agent(i))] + [rgba(palette.MIDTONE)] * len(names)
    headings = {
        BAR_LEFT + BAR_LENGTH / 2: "worst to best",
        NUMBER_X: "Q",
        GREEDY_X: "greedy",
        CHOSEN_X: "chosen",
    }
    labels += headings.values()
    places += [(x, -0.15 - LABEL_RISE) for x in headings]
    colours += [rgba(palette.MIDTONE)] * len(headings)
    words = rr.Points2D(places, labels=labels, colors=colours, radii=0.0, show_labels=True)
    stream.log(path, words, static=True)
