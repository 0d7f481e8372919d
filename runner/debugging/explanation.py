"""Which settings make the difference between two configurations: the result, as text and on disk.

recordings/.explain/NAME/values.jsonl       the readings of every run, a line each
recordings/.explain/NAME/explanation.json   the result
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Literal

from runner.analysis.compare.statistics import FEW_SEEDS, Estimate
from runner.analysis.sections import Grid, Section
from runner.errors import RunnerError, nearest
from runner.util.files import open_regular, replacing, storage_errors
from runner.util.humanize import counted, duration

FOLDER: Final = ".explain"
FILE: Final = "explanation.json"
MAX_BYTES: Final = 32 << 20
"""The largest file of a result that is read."""
ENOUGH: Final = 0.9
"""The part of the difference from which some settings count as making it."""
_MAX_MIXTURES: Final = 16
"""Mixtures that are listed as text."""


@dataclass(frozen=True)
class Side:
    """One of the two that are compared."""

    name: str
    run_id: str = ""
    """The run; empty if a configuration was given."""


@dataclass(frozen=True)
class Setting:
    """A setting that differs, or several that only go together, and its part in the difference."""

    name: str
    a: str
    b: str
    share: Estimate | None
    """Its Shapley value; None for a setting that is not in the minimal set."""
    alone: Estimate | None
    """The effect of changing it alone in A."""
    last: Estimate | None
    """The effect of changing it when all the others are as in B."""


@dataclass(frozen=True)
class Interaction:
    """What two settings do together beyond what each does."""

    settings: tuple[str, str]
    beyond: Estimate
    """The Shapley interaction index."""

    @property
    def is_clear(self) -> bool:
        """Whether the interval excludes 0."""
        return excludes_zero(self.beyond)


@dataclass(frozen=True)
class Mixture:
    """A configuration with some settings of B, the others of A."""

    settings: tuple[str, ...]
    """Those that have the value of B."""
    mean: Estimate
    values: tuple[float, ...]
    """By the order of the seeds."""


@dataclass(frozen=True)
class FirstStep:
    """Where a setting alone first changed what was learned, in two short runs that were recorded for it."""

    setting: str
    run_a: str
    """The run without the change."""
    run_b: str
    step: int | None
    """The training step whose update differs first; None if none did."""
    episode: int | None
    t: int | None
    sentences: tuple[str, ...]


@dataclass(frozen=True)
class Explanation:
    """Which settings make the difference between A and B in a metric."""

    name: str
    a: Side
    b: Side
    metric: str
    at: int | None
    """Training episodes after which the metric is read; None for the end of each configuration."""
    episodes: int
    """Training episodes of A."""
    seeds: tuple[int, ...]
    method: Literal["all mixtures", "delta debugging"]
    value_a: Estimate
    value_b: Estimate
    difference: Estimate
    """B less A, over the same seeds."""
    settings: tuple[Setting, ...]
    """The largest share first."""
    interactions: tuple[Interaction, ...]
    """The largest first."""
    smallest: Mixture | None
    """The fewest settings of B that make `ENOUGH` of the difference; None if there is no clear difference."""
    mixtures: tuple[Mixture, ...]
    """Those that were run, the fewest settings of B first."""
    first_step: FirstStep | None
    notes: tuple[str, ...]
    trained: int
    """Runs that were trained now; the others were known from before."""
    seconds: float

    @property
    def runs(self) -> int:
        """Runs that the result was computed from."""
        return len(self.mixtures) * len(self.seeds)

    def part(self, value: float) -> float:
        """Return a value as a part of the difference."""
        return value / self.difference.value if self.difference.value else float("nan")

    @property
    def has_difference(self) -> bool:
        """Whether the interval of the difference excludes 0."""
        return excludes_zero(self.difference)

    def as_json(self) -> dict[str, Any]:
        """Return the result as plain values; NaN where there is no interval."""
        return asdict(self)

    def _repr_html_(self) -> str:
        """Return the result for a notebook."""
        from runner.debugging.explain_page import explanation_html

        return explanation_html(self)


def excludes_zero(estimate: Estimate) -> bool:
    """Return whether the interval excludes 0; without an interval, whether the value is not 0."""
    if math.isnan(estimate.low):
        return estimate.value != 0
    return estimate.low > 0 or estimate.high < 0


# --- on disk ----------------------------------------------------------------------------------------------


def write_explanation(explanation: Explanation, recordings: Path) -> None:
    """Write a result next to what it was computed from.

    Raises:
        StorageError: the folder cannot be written.
    """
    path = recordings / FOLDER / explanation.name / FILE
    with storage_errors(path), replacing(path) as fresh:
        fresh.write_text(json.dumps(explanation.as_json()), encoding="utf-8")


def explanations_in(recordings: Path) -> list[str]:
    """Return the names of the results in a recordings folder."""
    return sorted(file.parent.name for file in (recordings / FOLDER).glob(f"*/{FILE}"))


def read_explanation(name: str, recordings: Path) -> Explanation:
    """Return a result from its file.

    Raises:
        RunnerError: there is none of this name, or its file is damaged.
    """
    from pydantic import TypeAdapter, ValidationError

    known = explanations_in(recordings)
    if name not in known:
        raise RunnerError(f"no explanation {name!r} in {recordings}.{nearest(name, known)}")
    path = recordings / FOLDER / name / FILE
    try:
        with open_regular(path) as file:
            content = file.read(MAX_BYTES + 1)
        if len(content) > MAX_BYTES:
            raise RunnerError(f"{path}: larger than {MAX_BYTES >> 20} MiB, expected an explanation.")
        return TypeAdapter(Explanation).validate_json(content)
    except (OSError, ValidationError) as error:
        reason = str(error).splitlines()[0]
        raise RunnerError(f"{path}: no longer describes an explanation ({reason}).") from error


# --- as text ----------------------------------------------------------------------------------------------


def summary(explanation: Explanation) -> list[str]:
    """Return the outcome in a few sentences."""
    metric, settings = explanation.metric, explanation.settings
    moment = f"after {explanation.episodes:,} episodes" if explanation.at else "at the end"
    sentences = [
        f"{metric} {moment}, the mean over {counted(len(explanation.seeds), 'seed')}: "
        f"{number(explanation.value_a.value)} in A, {number(explanation.value_b.value)} in B, "
        f"a difference of {signed(explanation.difference)}."
    ]
    if not explanation.has_difference:
        sentences.append("The interval includes 0: there is no clear difference to explain with these seeds.")
    elif explanation.smallest is not None:
        own = explanation.smallest
        names = " and ".join(own.settings) if len(own.settings) < 3 else ", ".join(own.settings)
        part = explanation.part(own.mean.value - explanation.value_a.value)
        of = f" of the {len(settings)} settings" if len(settings) > 1 else ""
        rest = " alone makes" if len(own.settings) == 1 else " together make"
        sentences.append(f"{names}{rest} {part:.0%} of it: the smallest set{of} that makes {ENOUGH:.0%}.")
    if len(explanation.seeds) < FEW_SEEDS:
        sentences.append(f"With fewer than {FEW_SEEDS} seeds the intervals are too narrow.")
    return sentences


def sections(explanation: Explanation) -> list[Section]:
    """Return the result as sections of sentences and tables."""
    title = f"{explanation.a.name} (A) and {explanation.b.name} (B)"
    notes = [f"Note: {note}." for note in explanation.notes]
    lines = [Section(title, [*summary(explanation), *notes]), _settings_section(explanation)]
    clear = [pair for pair in explanation.interactions if pair.is_clear]
    if explanation.interactions:
        lines.append(_interactions_section(explanation, clear))
    if explanation.first_step is not None:
        lines.append(Section("First step", list(explanation.first_step.sentences)))
    lines.append(_mixtures_section(explanation))
    return lines


def _settings_section(explanation: Explanation) -> Section:
    has_shares = any(setting.share is not None for setting in explanation.settings)
    rows = []
    for setting in explanation.settings:
        cells = [setting.name, setting.a, setting.b]
        if has_shares and setting.share is not None:
            part = f"{explanation.part(setting.share.value):.0%}" if explanation.has_difference else ""
            own = (setting.share, setting.alone, setting.last)
            cells += [signed(own[0]), part, *(number(one.value, True) if one else "" for one in own[1:])]
        elif has_shares:
            cells += ["not needed", "", "", ""]
        rows.append(tuple(cells))
    headings = ("setting", "A", "B")
    if not has_shares:
        return Section("Settings", [], [Grid(headings, rows)])
    text = (
        "A share is the effect of a setting, averaged over all orders in which the settings can be changed "
        "(Shapley value), with a 95 % bootstrap interval over seeds; the shares add up to the difference."
    )
    if explanation.method == "delta debugging":
        text = (
            "Delta debugging found settings that make the difference and of which none can be left out. "
            f"{text.replace('the difference', 'what they make together')}"
        )
    return Section("Shares", [text], [Grid((*headings, "share", "of all", "alone", "last"), rows)])


def _interactions_section(explanation: Explanation, clear: Sequence[Interaction]) -> Section:
    text = (
        "What two settings do together beyond what each does, averaged over the other settings (Shapley "
        "interaction index). Away from 0 the effect of one depends on the other."
    )
    if not clear:
        return Section("Which need each other", [text, "No interval excludes 0: their effects add up."])
    rows = [(" x ".join(pair.settings), signed(pair.beyond), _meaning(explanation, pair)) for pair in clear]
    pairs = len(explanation.interactions)
    sentences = [text]
    if pairs > len(clear):
        sentences.append(f"Listed are {len(clear)} of {pairs} pairs, those whose interval excludes 0.")
    return Section("Which need each other", sentences, [Grid(("settings", "together", ""), rows)])


def _meaning(explanation: Explanation, pair: Interaction) -> str:
    """Return what an interaction means for the two settings."""
    shares = {setting.name: setting.share for setting in explanation.settings}
    own = [shares[name] for name in pair.settings]
    signs = {share.value > 0 for share in own if share is not None and excludes_zero(share)}
    if len(signs) != 1:
        return "each changes what the other does"
    return "they need each other" if signs == {pair.beyond.value > 0} else "they replace each other in part"


def _mixtures_section(explanation: Explanation) -> Section:
    names = [setting.name for setting in explanation.settings]
    mixtures = explanation.mixtures
    left_out = len(mixtures) > _MAX_MIXTURES
    if left_out:  # A, each setting alone, all but one, B, and the smallest set
        chosen = (0, 1, len(names) - 1, len(names))
        mixtures = tuple(
            one for one in mixtures if len(one.settings) in chosen or one == explanation.smallest
        )
    rows = [
        (
            *("B" if name in one.settings else "A" for name in names),
            number(one.mean.value),
            _interval(one.mean),
        )
        for one in mixtures
    ]
    text = f"{counted(explanation.runs, 'run')}, {len(explanation.mixtures)} mixtures of the settings"
    text += f"; {len(mixtures)} of them are listed." if left_out else "."
    if explanation.trained:
        text += (
            f" {counted(explanation.trained, 'run')} were trained now, in {duration(explanation.seconds)}."
        )
    return Section("Mixtures", [text], [Grid((*names, explanation.metric, "95 %"), rows)])


def number(value: float, sign: bool = False) -> str:
    """Return a value with about four digits."""
    digits = 0 if abs(value) >= 1000 else 1 if abs(value) >= 10 else 2 if abs(value) >= 1 else 3
    return f"{value:+,.{digits}f}" if sign else f"{value:,.{digits}f}"


def _interval(estimate: Estimate) -> str:
    return "" if math.isnan(estimate.low) else f"{number(estimate.low)} to {number(estimate.high)}"


def signed(estimate: Estimate) -> str:
    """Return a difference with its interval: `+21.3 (19.8 to 22.7)`."""
    interval = _interval(estimate)
    return number(estimate.value, True) + (f" ({interval})" if interval else "")
