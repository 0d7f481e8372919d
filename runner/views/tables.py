"""Views of Q-values, of what a checkpoint's agent returns, and of an environment's transitions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, Final

from runner.analysis.sections import Grid, Section
from runner.errors import ConfigError
from runner.util.row_text import csv_lines, json_lines
from runner.views.view import NO_PROGRESS, ONLY_HERE, ReadyAnswer, ShownProgress, View, view_input

if TYPE_CHECKING:
    from runner.analysis.episodes import EpisodeRef
    from runner.analysis.qtable import QTables
    from runner.debugging.when import When
    from runner.debugging.why import Why
    from runner.environments.mdp import Mdp
    from runner.recording.reader import Recording
    from runner.runs.run import Run

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
        placeholder="a number, instead of a step",
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


QTABLE: Final = View(
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


WHEN: Final = View(
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


_STEPS: Final = 30
"""Steps that the page lists."""
_OF_STEP: Final = "a number or name, else the step's"


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
        placeholder="EPISODE:T or eval:N:TRIAL:T; else the end",
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


WHY: Final = View(
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


def values(
    run: Run,
    episode: EpisodeRef | None = ONLY_HERE,
    trial: EpisodeRef | None = ONLY_HERE,
    checkpoint: str | None = ONLY_HERE,
    policy: str | None = ONLY_HERE,
    trust: bool = ONLY_HERE,
    progress: ShownProgress = NO_PROGRESS,
) -> ReadyAnswer:
    """Compute what the agent of a checkpoint of RUN returns at each step of a recorded episode.

    --policy names a function of yours that takes the checkpoint's content (arrays by name, or bytes) and the
    spaces of observations and actions, and returns a function. That is called with the recorded observation
    before each step, and returns a number, an array, or a mapping of names to these. A checkpoint that is a
    pickle is loaded only with --trust.

    Examples:
      dualtaxi values cartpole --episode 3 --checkpoint @20000 --policy agent:values
      dualtaxi values cartpole --episode 3 --checkpoint policy@0 --policy agent:values -o values.csv
    """
    from runner.loops.policies import values_along
    from runner.recording.reader import open_recording
    from runner.runs.checkpoints import find_checkpoint

    at = episode or trial
    if episode and trial:
        raise ConfigError("--episode and --eval exclude each other: choose one.")
    if at is None or checkpoint is None or policy is None:
        needed = {"--episode or --eval": at, "--checkpoint": checkpoint, "--policy": policy}
        lacking = [name for name, value in needed.items() if value is None]
        raise ConfigError(f"found no {', no '.join(lacking)}; see `dualtaxi values --help`.")
    checkpoint_used = find_checkpoint(run.checkpoints(), checkpoint, f"run {run.run_id}")
    with open_recording(run.recording) as recording, progress.stage("computing values"):
        at = at.resolved(recording)
        number = at.number_in(recording)
        along = values_along(recording, at.phase, number, checkpoint_used, policy, trust)
    columns: dict[str, list[object]] = {"t": list(range(len(along.rewards)))}
    columns |= _columns("action", along.actions) | _columns("reward", along.rewards.sum(axis=1))
    for name, returned in along.values.items():
        columns |= _columns(name, returned)
    rows = list(zip(*columns.values(), strict=True))
    data = {
        "run_id": run.run_id,
        "phase": at.phase,
        "episode": number,
        "checkpoint": checkpoint_used.as_json(),
        "policy": policy,
        "steps": [dict(zip(columns, row, strict=True)) for row in rows],
    }
    cells = [tuple(f"{x:.4g}" if isinstance(x, float) else str(x) for x in row) for row in rows]
    grid = Grid(tuple(columns), cells, left=(), cut=())
    return ReadyAnswer(data, [Section("", grids=[grid])], lambda: "".join(csv_lines(columns, rows)))


def _columns(name: str, values: Any) -> dict[str, list[object]]:
    """Return values, nested as their space, as a column for each number."""
    if isinstance(values, Mapping):
        parts = (_columns(f"{name}.{key}", part) for key, part in values.items())
        return {key: column for part in parts for key, column in part.items()}
    if isinstance(values, tuple):
        return _columns(name, {str(i): part for i, part in enumerate(values)})
    if isinstance(values, list) or values.ndim == 1:
        return {name: values if isinstance(values, list) else values.tolist()}
    flat = values.reshape(len(values), -1)
    return {f"{name}[{i}]": flat[:, i].tolist() for i in range(flat.shape[1])}


VALUES: Final = View(
    "values", "Values", values, subject="run", file_ending=".csv", file_help="Write a CSV file."
)


_ROWS_AT_ONCE: Final = 50_000


def table(mdp: Mdp) -> ReadyAnswer:
    """Print an environment's transition table as CSV, with names.

    A row for each state, action and outcome that can happen: state, action, probability, next_state, reward,
    is_over. --set mode=competitive adds the reward of each agent. --json prints one line for each row. In
    Python: runner.frames.transition_table().

    Examples:
      dualtaxi table | head
      dualtaxi table --set env.kwargs.slip=0.1 > slippery.csv
      dualtaxi table --env FrozenLake-v1 --set env.kwargs.is_slippery=false
    """
    from runner.analysis.frames import transition_columns

    columns = transition_columns(mdp)

    def rows() -> Iterator[tuple[object, ...]]:
        for start in range(0, len(columns["state"]), _ROWS_AT_ONCE):
            part = [column[start : start + _ROWS_AT_ONCE].tolist() for column in columns.values()]
            yield from zip(*part, strict=True)

    objects = (dict(zip(columns, row, strict=True)) for row in rows())
    return ReadyAnswer(lines={"text": csv_lines(columns, rows()), "json": json_lines(objects)})


TABLE: Final = View("table", "Transitions", table, subject="environment", forms=("json",))
