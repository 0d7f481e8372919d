"""`find`: the episodes of all recorded runs that match an expression."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from runner.analysis.sections import Section
from runner.errors import ConfigError
from runner.query.text import reasons_in_words, without_pandas
from runner.util.extras import require
from runner.util.humanize import counted
from runner.views.view import NO_PROGRESS, ONLY_HERE, ReadyAnswer, ShownProgress, View, view_input


def find(
    folders: tuple[Path, ...],
    expression: str = view_input(
        "expression",
        "A condition on episodes.",
        required=True,
        label="Episodes",
        placeholder="ret < -100 and count(collision) >= 2 and length > 50",
    ),
    runs: str = ONLY_HERE,
    phase: str | None = view_input(
        "phase",
        "Training or evaluation.  [default: both]",
        values=("train", "eval"),
        label="Phase",
        placeholder="both",
    ),
    sort: str = view_input(
        "sort",
        "Sort by a number, such as ret, or -ret from the highest.",
        default="",
        metavar="NUMBER",
        label="Sort by",
        placeholder="newest run; or -ret",
    ),
    limit: int = view_input(
        "limit",
        "Maximum number of rows, 0 for all.  [default: 20]",
        kind=int,
        default=20,
        maximum=1000,
        label="Show at most",
        placeholder="0 to 1,000; 0 shows 1,000",
    ),
    mark: str | None = view_input(
        "mark", "Mark the first step of the episodes shown, as `dualtaxi mark` does.", metavar="TEXT"
    ),
    tags: Sequence[str] = ONLY_HERE,
    progress: ShownProgress = NO_PROGRESS,
) -> ReadyAnswer:
    """Find the episodes of all recorded runs that match EXPRESSION.

    It is a condition in Python's syntax. Words alone are searched for in the id, name, tags and note of runs.

    What the condition may contain:
      ret, ret.taxi_1, length          sum of rewards, or of an agent's rewards; number of steps
      success, terminated, truncated   how it ended
      any(C), all(C), never(C)         whether a condition holds at some, every or no step
      count(C)                         at how many steps it holds
      then(C, D, within=5)             whether D holds at most 5 steps after C
      min(V), max(V), sum(V), first(V), last(V)    of a value over the steps

    Of a step, in these functions: reward, t, state, next_state, next_observation[0], action, which is
    compared with its name or number; events such as collision, taxi_1.pickup, or pickup for any agent;
    explored; extra.NAME, a value that the loop recorded with the step. They are the columns of steps and
    extras that `dualtaxi sql` has.

    An index of episodes in the cache answers most of it; it is made when a run is first searched. Only the
    steps of episodes that the index cannot decide are read. Runs without a column that the expression names
    are left out. --quiet prints a line RUN PHASE EPISODES for each run.

    Examples:
      dualtaxi find 'ret < -100 and count(collision) >= 2 and length > 50'
      dualtaxi find 'any(action == "north + east") and success' --phase eval --sort length
      dualtaxi find 'max(next_observation[2]) > 0.2' --runs 'environment == "CartPole-v1"'
      dualtaxi find 'then(pickup, drop_off, within=5)' --sort -ret --json
      dualtaxi find 'min(reward) < -15' --mark expensive --tag look-again
      dualtaxi find 'ret > 15' --phase train --quiet --limit 0
    """
    if tags and mark is None:
        raise ConfigError(
            "--tag needs --mark TEXT, as it is a tag of the marks; words find the tags of runs."
        )
    require("pyarrow", extra="sql", purpose="`find`")
    from runner.query import find as query

    with without_pandas(), progress.stage("reading") as report:
        found = query.find(
            expression, folders, runs=runs, phase=phase, sort=sort, limit=limit or None, report=report
        )
    marked = None if mark is None else found.mark(mark, tags=tags)

    def say_how_many() -> None:
        progress.say(found.sentence)
        if len(found.hits) < found.count:
            progress.say(f"Shown are the first {len(found.hits):,}; --limit 0 shows all.")
        if marked is not None:
            had = len(found.hits) - marked
            progress.say(f"Marked {counted(marked, 'episode')}; {had:,} had this mark.")

    def sections() -> Iterator[Section]:
        if found.hits:
            yield Section("", grids=[found.grid])
        say_how_many()

    def lines() -> Iterator[str]:
        for (run, of_phase), episodes in found.episodes.items():
            yield f"{run} {of_phase} {','.join(map(str, episodes))}\n"
        say_how_many()

    data = found.as_json() | ({} if marked is None else {"marked": marked})
    return ReadyAnswer(data, sections(), lines={"quiet": lines()}, remarks=reasons_in_words(found))


VIEW: Final = View(
    "find",
    "Find episodes",
    find,
    subject="folders",
    button="Find",
    lead="A condition on episodes. C and D are conditions on a step, and V is a value of a step: `reward`, "
    "`t`, `action`, `state`, `next_state`, `next_observation[0]`, `extra.NAME`, `explored`, or an event such "
    "as `collision` or `taxi_1.pickup`.",
    list_title="What the condition may contain",
    forms=("quiet", "json", "markdown"),
)
