"""`why`: the rewards and initial values that a Q-value is the sum of."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from runner.views.view import NO_PROGRESS, ShownProgress, View, view_input

if TYPE_CHECKING:
    from runner.debugging.q_value import Why
    from runner.recording.reader import Recording

_STEPS: Final = 30
"""Steps that the page lists."""
_OF_STEP: Final = "number or name; that of the step"


def why(
    recording: Recording,
    state: str | None = view_input(
        "state",
        "The state: a number or a name.  [default: that of --at]",
        metavar="S",
        label="State",
        placeholder=_OF_STEP,
    ),
    action: str | None = view_input(
        "action",
        "The action: a number or a name.  [default: that of --at]",
        metavar="A",
        label="Action",
        placeholder=_OF_STEP,
    ),
    agent: str | None = view_input(
        "agent",
        "The agent, if each agent has a Q-table of its own.",
        metavar="NAME",
        label="Agent",
        choices=lambda recording: recording.agents,
    ),
    at: str | None = view_input(
        "at",
        "The step: EPISODE:T, step:N, eval:N:TRIAL:T, typical, best, worst or last; T defaults to 0, so 120 "
        "is the start of episode 120. The value before the step is shown.  [default: the last]",
        metavar="STEP",
        max_length=60,
        label="Before step",
        placeholder="EPISODE:T, step:N, eval:N:TRIAL:T, best or last; the end",
    ),
    limit: int = view_input(
        "limit",
        "Maximum number of rows, 0 for all.  [default: 10]",
        kind=int,
        default=10,
        maximum=100_000,
    ),
    progress: ShownProgress = NO_PROGRESS,
) -> Why:
    """Show where a Q-value of RUN comes from: the recorded rewards and initial values that it is the sum of.

    Each update is linear in the tables once its greedy action is known, so a value is exactly a weighted sum
    of the rewards before it and of the initial values. It is listed by reward, by episode, and by the steps
    that add or take most. This is a decomposition along the path that training took, not a counterfactual:
    `dualtaxi branch` shows what would have happened otherwise. In Python: runner.why().

    Examples:
      dualtaxi why @latest --state 300 --action north+south
      dualtaxi why rivals --state 300 --action pickup --agent taxi_2 --at 2000:0
      dualtaxi why k3v9m2xq --at eval:3000:7:5 --limit 30
    """
    from runner.debugging.why import why

    with progress.steps("reading") as report:
        return why(recording, state=state, action=action, agent=agent, at=at, limit=limit, report=report)


def _refusal(recording: Recording) -> str:
    from runner.debugging.why import why_refusal

    return why_refusal(recording)


VIEW: Final = View(
    "why",
    "Why?",
    why,
    button="Explain the value",
    lead="A Q-value is exactly a weighted sum of recorded rewards and initial values. This page shows which "
    "ones, and by which moves they came.",
    page_values=(("limit", _STEPS),),
    needs="training",
    exclusive_spool=True,
    refusal=_refusal,
)
