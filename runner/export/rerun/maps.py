"""The map: the greatest value and the greedy moves for every placement of the movers.

The first mover's cells lie within blocks, and each block is a cell of the second; for the second mover's
own table it is the other way round.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from runner.drawing import palette
from runner.export.rerun.classes import Vocabulary
from runner.export.rerun.columns import (
    Batch,
    Sender,
    centres,
    images,
    ink,
    instances,
    lists,
    place,
    rgba,
    texts,
)
from runner.export.rerun.scene import Placements, Scene, own_actions

LABEL_Y: Final = -2.6
_LETTER_RISE: Final = 0.6
"""How much higher a point must be for its letter, which is written below it, to stand in its cell."""
_ASIDE: Final = 0.21
"""From the centre of a pixel to the arrow of either of two agents."""


class MapWriter(Sender):
    """Sends the maps of one phase, one a learner."""

    def __init__(
        self,
        stream: rr.RecordingStream,
        path: str,
        scene: Scene,
        pictures: Placements,
        words: Vocabulary,
        learners: tuple[str, ...],
    ) -> None:
        super().__init__(stream, path)
        self._scene = scene
        self._mdp = scene.mdp
        self._pictures = pictures
        self._words = words
        self._learners = learners
        self._own = own_actions(self._mdp)
        self._moves = [self._agent_moves(agent) for agent in range(len(self._mdp.agents))]
        self._orders = [pictures.order(self._first_mover(i)) for i in range(len(learners))]
        """[pixels] a learner: which pixel of the common picture each of its own is."""

    def dress(self) -> None:
        """Log sizes and colours."""
        pictures = self._pictures
        middle = centres(pictures.height, pictures.width)
        shape = rr.components.ImageFormat(
            width=pictures.width,
            height=pictures.height,
            channel_datatype=rr.ChannelDatatype.F32,
            color_model=rr.ColorModel.L,
        )
        for i, learner in enumerate(self._learners):
            shown = self._agents(i)
            origins = self._beside(len(shown)).reshape(-1, 2)
            tints = [rgba(palette.agent(k)) for k in shown for _ in middle]
            self.static(
                f"map/{learner}",
                rr.DepthImage.from_fields(format=shape, colormap=rr.components.Colormap.Viridis),
            )
            self.static(
                f"map/{learner}/moves",
                rr.Arrows2D.from_fields(origins=origins, colors=tints, radii=0.06, draw_order=40.0),
            )
            self.static(
                f"map/{learner}/here",
                rr.Boxes2D.from_fields(colors=[rgba(palette.BAD)], radii=0.1, draw_order=50.0),
            )
            self.static(
                f"map/{learner}/stops",
                rr.Points2D.from_fields(radii=0.0, show_labels=True, draw_order=45.0),
            )
            self.static(f"map/{learner}/label", rr.Points2D.from_fields(radii=0.0, show_labels=True))

    def write(self, batch: Batch) -> None:
        """Send where each step of a batch is in the map, and the map where it was renewed."""
        assert batch.values is not None
        pictures, known, n = self._pictures, batch.values, len(batch.records)
        middle = centres(pictures.height, pictures.width)
        rows, times = known.renewed, batch.times()
        for i, learner in enumerate(self._learners):
            order = self._orders[i]
            pixel = np.argsort(order)[pictures.pixel[batch.records["state"]]]
            here = instances(rr.Boxes2D, n, centers=middle[pixel][:, None])
            self.send(f"map/{learner}/here", times, here)
            if len(rows):
                greedy = known.greedy_maps[:, i][:, order]
                self.send(f"map/{learner}/stops", batch.times(rows), self._stops(i, greedy))
                self._renew(batch, rows, learner, known.value_maps[:, i][:, order], self._arrows(i, greedy))

    def _renew(
        self,
        batch: Batch,
        rows: NDArray[np.int64],
        learner: str,
        values: NDArray[np.float32],
        moves: NDArray[np.float32],
    ) -> None:
        times, n = batch.times(rows), len(rows)
        self.send(f"map/{learner}", times, images(values))
        frame = instances(rr.Boxes2D, n, half_sizes=np.full((n, 1, 2), 0.5, np.float32))
        self.send(f"map/{learner}/here", times, frame)
        self.send(f"map/{learner}/moves", times, instances(rr.Arrows2D, n, vectors=moves))
        contexts = self._pictures.context[batch.records["state"][rows]].tolist()
        names = self._pictures.names
        labels = texts(
            [
                f"as of step {time:,}\n{names[context]}"
                for time, context in zip(batch.time[rows].tolist(), contexts, strict=True)
            ]
        )
        points = place(n, self._pictures.width / 2, LABEL_Y)
        columns = instances(rr.Points2D, n, positions=points, labels=labels, colors=ink(n))
        self.send(f"map/{learner}/label", times, columns)

    def _agents(self, learner: int) -> list[int]:
        """Return the agents whose moves a learner's table decides."""
        agents = range(len(self._mdp.agents))
        return [learner] if len(self._learners) == len(agents) else list(agents)

    def _first_mover(self, learner: int) -> int:
        """Return which mover's cells lie within the blocks of a learner's map."""
        return self._mover(self._agents(learner)[0])

    def _mover(self, agent: int) -> int:
        things = self._scene.description["things"]
        named = [things[mover].get("agent") for mover in self._scene.movers]
        name = self._mdp.agents[agent]
        return named.index(name) if name in named else 0

    def _arrows(self, learner: int, greedy: NDArray[np.int32]) -> NDArray[np.float32]:
        """Return the arrows of greedy actions, [k, agents * pixels, 2]."""
        from runner.export.rerun import filling  # Numba is slow to load, and a live view has no maps

        shown = self._agents(learner)
        own = self._own[:, shown] if len(shown) > 1 else np.arange(len(self._moves[shown[0]]))[:, None]
        arrows = np.empty((len(greedy), len(shown), greedy.shape[1], 2), np.float32)
        filling.arrows(greedy, own, np.stack([self._moves[agent] for agent in shown]), arrows)
        return arrows.reshape(len(greedy), -1, 2)

    def _stops(self, learner: int, greedy: NDArray[np.int32]) -> list[Any]:
        """Return the columns of the letters of greedy actions that are no moves."""
        shown = self._agents(learner)
        own = [greedy if len(shown) == 1 else self._own[greedy, agent] for agent in shown]
        letters = [self._words.stops[agent][part] for agent, part in zip(shown, own, strict=True)]
        classes = np.where((greedy >= 0)[:, None], np.stack(letters, axis=1), -1)
        row, agent, pixel = np.nonzero(classes >= 0)
        return lists(
            rr.Points2D,
            np.bincount(row, minlength=len(greedy)),
            positions=self._beside(len(shown))[agent, pixel] - np.array([0.0, _LETTER_RISE], np.float32),
            class_ids=classes[row, agent, pixel].astype(np.uint16),
        )

    def _beside(self, agents: int) -> NDArray[np.float32]:
        """Return where the greedy action of each of so many agents is shown, [agents, pixels, 2]."""
        middle = centres(self._pictures.height, self._pictures.width)
        x = (np.arange(agents) - (agents - 1) / 2) * 2 * _ASIDE
        aside = np.stack((x, np.zeros(agents)), axis=1).astype(np.float32)
        return np.asarray(middle[None] + aside[:, None])

    def _agent_moves(self, agent: int) -> NDArray[np.float32]:
        """Return the arrow of each own action of an agent, [actions, 2]."""
        own = self._own[:, agent]
        first = [int(np.argmax(own == action)) for action in range(self._mdp.action_counts[agent])]
        moves: NDArray[np.float32] = self._scene.moves[first, self._mover(agent)] * np.float32(1.2)
        return moves


def draw_blocks(stream: rr.RecordingStream, path: str, pictures: Placements) -> None:
    """Log the lines between the blocks of the map."""
    rows, columns = pictures.block
    across = [[(0, y), (pictures.width, y)] for y in range(0, pictures.height + 1, rows)]
    down = [[(x, 0), (x, pictures.height)] for x in range(0, pictures.width + 1, columns)]
    lines = rr.LineStrips2D(across + down, colors=[(255, 255, 255)], radii=0.06, draw_order=30)
    stream.log(path, lines, static=True)
