"""`qtable`: the exact Q-table at any step."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from runner.views.view import NO_PROGRESS, ShownProgress, View, view_input

if TYPE_CHECKING:
    from runner.analysis.qtable import QTables
    from runner.recording.reader import Recording

_MAX_STEP: Final = 2**62


def qtable(
    recording: Recording,
    step: int | None = view_input(
        "step",
        "After N training steps.  [default: the last]",
        kind=int,
        maximum=_MAX_STEP,
        label="After step",
        placeholder="the last",
    ),
    episode: int | None = view_input(
        "episode",
        "After N training episodes.",
        kind=int,
        maximum=_MAX_STEP,
        label="After episode",
        placeholder="number; that of the step",
    ),
    state: str | None = view_input(
        "state",
        "The state: a number or a name; shows its values and their history.",
        metavar="S",
        label="State",
        placeholder="number or name",
    ),
    progress: ShownProgress = NO_PROGRESS,
) -> QTables:
    """Show the exact Q-table of RUN at any step: the nearest snapshot, with the recorded steps replayed.

    For your own loop it is the latest snapshot before the step: each array of [states, actions] that
    rec.snapshot() recorded, which the output names with its step.

    --state shows its values, the policy if the algorithm learns one, the greedy action (ties go to the
    first), how often each action was taken there so far, and which step last changed each value. In Python:
    runner.replay.tables.tables_at().

    Examples:
      dualtaxi qtable @latest --episode 500
      dualtaxi qtable k3v9m2xq --step 50000 --state 17
      dualtaxi qtable k3v9m2xq --step 50000 -o table.npy
    """
    from runner.analysis.qtable import tables_of

    with progress.stage("replaying recorded steps"):
        return tables_of(recording, step, episode, state)


VIEW: Final = View(
    "qtable",
    "Q-table",
    qtable,
    button="Show the table",
    needs="tables",
    has_default=True,
    file_ending=".npy",
    file_help="Write the whole table: float64 [states, actions], of several agents [agents, states, "
    "actions].",
)
