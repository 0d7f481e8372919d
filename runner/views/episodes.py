"""`episodes`: how the episodes of a run ended, with a link to the replay of each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from runner.analysis.sections import Answer, Grid, Paging, Section
from runner.util.humanize import counted, number_column
from runner.views.view import START, STOP, View, rows_in, view_input

if TYPE_CHECKING:
    from runner.analysis.episodes import EpisodeRef
    from runner.analysis.frames import Phase
    from runner.recording.reader import Recording
    from runner.util.values import Json

_ROWS: Final = 100
_HIDDEN: Final = ("success", "terminated", "truncated", "episode", "last_step")
"""Columns that the table does not show as they are."""


_PHASE: Final = view_input(
    "phase",
    "Training episodes, or the trials of evaluations.  [default: train]",
    default="train",
    label="Phase",
    values=("train", "eval"),
)


_ORDER: Final = view_input(
    "order",
    "What comes first: newest, best, worst (by success, return and length), longest or shortest.  "
    "[default: number]",
    default="number",
    metavar="ORDER",
    label="Order",
    values=("number", "newest", "best", "worst", "longest", "shortest"),
)


@dataclass(frozen=True)
class EpisodeRows(Answer):
    """Some episodes of a phase."""

    run_id: str
    phase: str
    order: str
    start: int
    total: int
    """Number of all episodes of the phase."""
    columns: Mapping[str, list[Any]]
    references: Sequence[EpisodeRef]
    headings: dict[str, str]
    """Heading of each column of the table."""

    def as_json(self) -> Json:
        """Return a list for each column."""
        return {
            "run_id": self.run_id,
            "start": self.start,
            "total": self.total,
            "columns": dict(self.columns),
        }

    def sections(self) -> list[Section]:
        """Return a table with a row for each episode."""
        from runner.analysis.contents import END_WORDS
        from runner.analysis.episodes import UNKNOWN_EVALUATION

        is_training = self.phase == "train"
        title = "Training episodes" if is_training else "Trials of evaluations"
        if not self.references:
            text = f"There are {self.total:,}, from 0." if self.total else "None was recorded."
            return [Section(title, [text])]
        cells = [number_column(self.columns[name]) for name in self.headings]
        rows = [
            (
                str(at.episode)
                if at.after in (None, UNKNOWN_EVALUATION)
                else f"{at.after}, trial {at.episode}",
                next((END_WORDS[end] for end in _HIDDEN[:3] if self.columns[end][i] > 0), END_WORDS["reset"]),
                *(column[i] for column in cells),
            )
            for i, at in enumerate(self.references)
        ]
        links = [
            "" if at.after == UNKNOWN_EVALUATION else f"replay/{at.episode_path}" for at in self.references
        ]
        paging = Paging(
            self.start // _ROWS + 1, self.total, _ROWS, f"{VIEW.name}?phase={self.phase}&order={self.order}"
        )
        headings = ("episode" if is_training else "trial", "end", *self.headings.values())
        spare = [text for name, text in reversed(self.headings.items()) if "return" not in name]
        grid = Grid(headings, rows, links=links, paging=paging, cut=(), spare=tuple(spare))
        sentence = counted(self.total, "episode" if is_training else "trial")
        if len(rows) < self.total:
            sentence = f"Rows {self.start:,} to {self.start + len(rows) - 1:,} of {sentence}"
        return [Section(title, [f"{sentence}."], [grid])]


def episodes(
    recording: Recording,
    phase: Phase = _PHASE,
    order: str = _ORDER,
    start: Any = START,
    stop: Any = STOP,
) -> EpisodeRows:
    """Show the episodes of RUN: how each ended, its length, returns and events.

    In Python, runner.frames.episodes() has all of them.

    Examples:
      dualtaxi episodes @latest
      dualtaxi episodes k3v9m2xq --phase eval --start 100 --stop 200
      dualtaxi episodes k3v9m2xq --order longest --stop 10
    """
    from runner.analysis.episodes import in_order, references
    from runner.analysis.frames import columns_of_episodes, episode_columns
    from runner.environments.naming import event_in_words

    total, rows = recording.phase(phase).episodes.count(), rows_in(start, stop)
    if order == "number":
        columns = episode_columns(recording, phase, min(rows.start, total), min(rows.stop, total))
    else:
        numbers = in_order(recording, phase, order)[rows.start : rows.stop]
        columns = columns_of_episodes(recording, recording.phase(phase).episodes.chosen(numbers))
    shown = [name for name in columns if name not in _HIDDEN]
    if recording.environment["penalty_below"] is None:
        shown.remove("penalties")
    headings = {name: event_in_words(name) for name in shown}
    for agent in recording.agents:
        name = f"return.{agent}"
        headings[name] = "return" if len(recording.agents) == 1 else event_in_words(name)
    values = {name: column.tolist() for name, column in columns.items()}
    at = references(recording, phase, values["episode"])
    return EpisodeRows(recording.run_id, phase, order, rows.start, total, values, at, headings)


VIEW: Final = View(
    "episodes",
    "Episodes",
    episodes,
    button="Show",
    has_default=True,
    is_live=True,
    needs="episodes",
    rows_per_page=_ROWS,
)
