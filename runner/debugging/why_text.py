"""Where a Q-value comes from, as facts, sentences and tables: for the terminal, pages and notebooks."""

from __future__ import annotations

from typing import Final

from runner.analysis.sections import Grid, Section
from runner.debugging.why import EXPLANATION, EpisodesPart, Part, StepPart, Why
from runner.environments.naming import spoken

MAX_ROWS: Final = 12
"""Kinds of rewards that are shown."""


def facts_of(found: Why) -> dict[str, str]:
    """Return the run, the state, the action and the value as text, by name."""
    return {
        "run": found.run_id,
        "state": f"{found.state}: {found.state_in_words}",
        "action": f"{found.action}: {found.action_in_words}, of {spoken(found.agent)}",
        "value": f"{found.value:.9g} after {found.step:,} training steps",
    }


def sections_of(found: Why) -> list[Section]:
    """Return all parts of the sum; the section of steps is the last one."""
    whole = found.rewarded.weight + found.initial.weight

    def cells(part: Part) -> tuple[str, str, str]:
        share = 100 * part.weight / whole if whole else 0.0
        return f"{part.contribution:+.4g}", f"{part.weight:.4g}", f"{share:.3g} %"

    columns = ("adds", "weight", "of all weight")
    sums = [
        (f"rewards of {found.counted:,} of {found.step:,} steps", *cells(found.rewarded)),
        ("initial values", *cells(found.initial)),
        ("sum", f"{found.total:.9g}", f"{whole:.4g}", ""),
    ]
    rest = found.rewards[MAX_ROWS:]
    rewards = [
        ("other rewards" if part.reward is None else f"{part.reward:+g}", part.events or "none", *cells(part))
        for part in found.rewards[:MAX_ROWS]
    ]
    if rest:
        others = Part(sum(part.weight for part in rest), sum(part.contribution for part in rest))
        rewards.append((f"{len(rest)} other kinds", "", *cells(others)))
    off = f"It differs from the table's value by {abs(found.total - found.value):.1g}, by rounding."
    return [
        Section(
            "The sum", [off, EXPLANATION, *([found.note] if found.note else [])], [Grid(("", *columns), sums)]
        ),
        Section("By reward", [], [Grid(("reward", "events", *columns), rewards)]),
        Section(
            "By episode",
            [],
            [
                Grid(
                    ("episodes", *columns),
                    [(_episodes(part), *cells(part)) for part in found.episodes],
                )
            ],
        ),
        Section(
            "The steps that add or take most",
            [] if found.steps else ["No reward adds to the value or takes from it."],
            [
                Grid(
                    ("step", "state", "action", "reward", *columns, "steps away"),
                    [_step(part, cells(part)) for part in found.steps],
                )
            ]
            if found.steps
            else [],
        ),
    ]


def _episodes(part: EpisodesPart) -> str:
    return f"{part.start:,}" if part.stop == part.start + 1 else f"{part.start:,} to {part.stop - 1:,}"


def _step(part: StepPart, cells: tuple[str, str, str]) -> tuple[str, ...]:
    action = f"{part.action_in_words} ({part.explored})" if part.explored else part.action_in_words
    reward = f"{part.reward:+g}, {part.events}" if part.events else f"{part.reward:+g}"
    return part.at, f"{part.state}: {part.state_in_words}", action, reward, *cells, f"{part.distance:.1f}"
