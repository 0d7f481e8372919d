"""`episodes`: how the episodes of a run ended, with a link to the replay of each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from runner.analysis.sections import Grid, Paging, Section
from runner.util.humanize import counted, number_column
from runner.views.view import START, STOP, ReadyAnswer, View, rows_in, view_input

if TYPE_CHECKING:
    from runner.analysis.episodes import EpisodeRef
    from runner.analysis.frames import Phase
    from runner.recording.reader import Recording

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


def episodes(
    recording: Recording,
    phase: Phase = _PHASE,
    order: str = _ORDER,
    start: Any = START,
    stop: Any = STOP,
) -> ReadyAnswer:
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
    episodes_shown = references(recording, phase, values["episode"])
    is_training = phase == "train"
    sentence = counted(total, "episode" if is_training else "trial")
    if not episodes_shown:
        sentence = f"There are {total:,}, from 0" if total else "None was recorded"
    elif len(episodes_shown) < total:
        sentence = f"Rows {rows.start:,} to {rows.start + len(episodes_shown) - 1:,} of {sentence}"
    address = f"{VIEW.name}?phase={phase}&order={order}"
    paging = Paging(rows.start // _ROWS + 1, total, _ROWS, address)
    table = Section(
        "Training episodes" if is_training else "Trials of evaluations",
        [f"{sentence}."],
        [_grid(is_training, values, episodes_shown, headings, paging)] if episodes_shown else [],
    )
    data = {"run_id": recording.run_id, "start": rows.start, "total": total, "columns": values}
    return ReadyAnswer(data, [table])


def _grid(
    is_training: bool,
    columns: Mapping[str, list[Any]],
    numbers: Sequence[EpisodeRef],
    headings: dict[str, str],
    paging: Paging,
) -> Grid:
    """Return a table with a row for each episode, and a column for each heading."""
    from runner.analysis.contents import END_WORDS
    from runner.analysis.episodes import UNKNOWN_EVALUATION

    cells = [number_column(columns[name]) for name in headings]
    rows = [
        (
            str(at.episode) if at.after in (None, UNKNOWN_EVALUATION) else f"{at.after}, trial {at.episode}",
            next((END_WORDS[end] for end in _HIDDEN[:3] if columns[end][i] > 0), END_WORDS["reset"]),
            *(column[i] for column in cells),
        )
        for i, at in enumerate(numbers)
    ]
    links = ["" if at.after == UNKNOWN_EVALUATION else f"replay/{at.episode_path}" for at in numbers]
    names = ("episode" if is_training else "trial", "end", *headings.values())
    spare = [text for name, text in reversed(headings.items()) if "return" not in name]
    return Grid(names, rows, links=links, paging=paging, cut=(), spare=tuple(spare))


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
