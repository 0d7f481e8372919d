"""`when`: the training steps after which something holds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from runner.views.view import NO_PROGRESS, ShownProgress, View, view_input

if TYPE_CHECKING:
    from runner.debugging.when import When
    from runner.recording.reader import Recording

_INTERVALS: Final = 200
"""The most intervals that the page lists."""


def when(
    recording: Recording,
    expression: str = view_input(
        "expression",
        "A condition, such as max(q[300]) > 20.",
        required=True,
        label="Expression",
        placeholder='max(q[300]) > 20 and greedy[300] == "pickup + east"',
    ),
    every: bool = view_input(
        "all",
        "Include everything, not only a selection: every interval in which it holds, with its end.",
        kind=bool,
        default=False,
        button="Find every interval",
    ),
    first: str | None = view_input(
        "from",
        "The first training step: EPISODE:T, or step:N by its number.",
        metavar="STEP",
        max_length=40,
        label="From step",
        placeholder="0:0",
    ),
    last: str | None = view_input(
        "to",
        "The last training step, as for --from.",
        metavar="STEP",
        max_length=40,
        label="To step",
        placeholder="the last",
    ),
    progress: ShownProgress = NO_PROGRESS,
    **limits: int,
) -> When:
    """Find the first training step of RUN after which EXPRESSION holds, exactly: every step is replayed.

    --all lists every interval in which it holds.

    What an expression may contain:
      q[S, A]                         a Q-value; max(q[S]) and min(q[S]) the highest and lowest of a state
      greedy[S]                       the greedy action, such as greedy[S] == "pickup + east"
      greedy_success[S]               whether the greedy path from S succeeds within the step limit
      visits[S], visits[S, A]         training steps that began in S, with action A
      step, episode                   numbers of the training step and of its episode
      reward, epsilon                 of the training step
      q.taxi_1[S, A], reward.taxi_1   the same of one agent, if each has a table of its own
      and or not < <= > >= == !=      comparisons can be chained
      + - * / // % max() min() abs()  arithmetic

    S and A are numbers or names, as `dualtaxi table` prints them; in greedy[S] and visits[S, A] they are of
    joint actions.

    Examples:
      dualtaxi when @latest 'greedy[300] == "pickup + east"'
      dualtaxi when k3v9m2xq 'q[300, "north + east"] > q[300, "west + east"]' --all
      dualtaxi when k3v9m2xq 'greedy_success[300] and visits[300] < 100' --from 2000:0
      dualtaxi when rivals 'max(q.taxi_1[300]) > max(q.taxi_2[300]) > 0' --to step:50000
    """
    from runner.debugging.when import when

    with progress.steps("searched") as report:
        return when(recording, expression, every=every, first=first, last=last, report=report, **limits)


VIEW: Final = View(
    "when",
    "When?",
    when,
    button="Find the first step",
    lead="The expression is evaluated after every training step. S and A are a state and an action, by "
    "number or by name; a step is EPISODE:T, or step:N by its number in training.",
    needs="training",
    list_title="What an expression may contain",
    page_values=(("limit", _INTERVALS),),
)
