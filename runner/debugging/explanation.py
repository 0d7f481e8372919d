"""Which settings make the difference between two configurations: the result, as text, as pictures, on disk.

recordings/.explain/A-B-1f2e3d4c/values.jsonl           the readings of every run, a line each
recordings/.explain/A-B-1f2e3d4c/success_percent.json   the explanation of a metric
recordings/.explain/runs/                               the short runs that show first steps
"""

from __future__ import annotations

import contextlib
import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np

from runner.analysis.sections import Figure, Grid, Section, html
from runner.analysis.statistics import Estimate, bootstrap_ratio
from runner.errors import RunnerError, nearest
from runner.export.plots.comparisons import BarColumn, bars_chart, mixtures_chart
from runner.runs.catalogue.removal import Removal, plan, remove
from runner.runs.run import UNLISTED, acquired, list_runs
from runner.util.files import open_regular, replacing, storage_errors
from runner.util.humanize import counted, duration, size
from runner.util.values import Json

ENOUGH: Final = 0.9
"""The part of the difference from which some settings count as making it."""
_FEW_SEEDS: Final = 20
"""With fewer seeds, percentile bootstrap intervals of a mean are clearly too narrow."""
_MAX_MIXTURES: Final = 16
"""Mixtures that are listed as text."""
FOLDER: Final = ".explain"
LOCK: Final = "owner.lock"
TAG: Final = "explain={}"
"""The tag of the short runs of an explanation, with its name."""
_MAX_BYTES: Final = 32 << 20
"""The largest file of a result that is read."""
_MAX_VALUE: Final = 1e15
"""Larger values cannot come from a metric."""


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
    """The effect that two settings have together beyond the effect of each."""

    settings: tuple[str, str]
    beyond: Estimate
    """The Shapley interaction index."""


@dataclass(frozen=True)
class Mixture:
    """A configuration with some settings of B, the others of A."""

    settings: tuple[str, ...]
    """The settings that have the value of B."""
    mean: Estimate
    values: tuple[float, ...]
    """In the order of the seeds."""


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
    """The folder of the pair, and the metric: `first-second-1f2e3d4c/success_percent`."""
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
    """The fewest settings of B that make `ENOUGH` of the difference; with delta debugging, settings of which
    none can be left out. None if there is no clear difference."""
    mixtures: tuple[Mixture, ...]
    """The mixtures that were run, the fewest settings of B first."""
    first_step: FirstStep | None
    notes: tuple[str, ...]
    trained: int
    """Runs that were trained for this result; the others were measured before."""
    seconds: float

    @property
    def runs(self) -> int:
        """Runs that the result was computed from."""
        return len(self.mixtures) * len(self.seeds)

    @property
    def clear_interactions(self) -> list[Interaction]:
        """Interactions whose interval excludes 0."""
        return [pair for pair in self.interactions if pair.beyond.excludes_zero]

    def part(self, value: float) -> float:
        """Return a value as a part of the difference."""
        return value / self.difference.value if self.difference.value else float("nan")

    def part_of(self, mixture: Mixture) -> Estimate:
        """Return the part of the difference that a mixture makes, with its interval over seeds."""
        low, *_, high = (np.array(mixture.values) for mixture in self.mixtures)
        return bootstrap_ratio(np.array(mixture.values) - low, high - low)

    def as_json(self) -> Json:
        """Return the result as plain values; NaN where there is no interval."""
        return asdict(self)

    def _repr_html_(self) -> str:
        """Return pictures and text for a notebook."""
        return html(drawn_sections(self))


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
    if not explanation.difference.excludes_zero:
        sentences.append("The interval includes 0: there is no clear difference to explain with these seeds.")
    elif explanation.smallest is not None:
        smallest = explanation.smallest.settings
        *others, last = smallest
        names = f"{', '.join(others)} and {last}" if others else last
        part = explanation.part_of(explanation.smallest)
        has_interval = not math.isnan(part.low) and part.low != part.high
        interval = f" ({_percent(part.low)} to {_percent(part.high)})" if has_interval else ""
        of = f" of the {len(settings)} settings" if len(settings) > 1 else ""
        make = "together make" if others else "alone makes"
        least = f"the smallest set{of} that makes {_percent(ENOUGH)}"
        if explanation.method == "delta debugging":
            least = (
                f"a set{of} that makes {_percent(ENOUGH)} and of which none can be left out; there may be a "
                "smaller one"
            )
        sentences.append(f"{names} {make} {_percent(part.value)}{interval} of it: {least}.")
    if len(explanation.seeds) < _FEW_SEEDS:
        sentences.append(
            f"With fewer than {_FEW_SEEDS} seeds the intervals are too narrow: of 10 seeds, one of 95 % "
            "holds 84 to 91 % of the time."
        )
    of_a, *_, of_b = explanation.mixtures
    same = sum(low == high for low, high in zip(of_a.values, of_b.values, strict=True))
    if 2 * same > len(explanation.seeds) and explanation.difference.value:
        sentences.append(
            f"A and B have the same value with {same} of the {len(explanation.seeds)} seeds, so the "
            "intervals rest on a few seeds and are far too narrow."
        )
    return sentences


def sections(explanation: Explanation) -> list[Section]:
    """Return the result as sections of sentences and tables."""
    title = f"{explanation.a.name} (A) and {explanation.b.name} (B)"
    notes = [f"Note: {note}." for note in explanation.notes]
    result = [Section(title, [*summary(explanation), *notes]), _settings_section(explanation)]
    if explanation.interactions:
        result.append(_interactions_section(explanation))
    if explanation.first_step is not None:
        result.append(Section("First step", list(explanation.first_step.sentences)))
    return [*result, _mixtures_section(explanation)]


def _settings_section(explanation: Explanation) -> Section:
    has_shares = any(setting.share is not None for setting in explanation.settings)
    is_clear = explanation.difference.excludes_zero
    rows = []
    for setting in explanation.settings:
        cells = [setting.name, setting.a, setting.b]
        if has_shares and setting.share is not None:
            part = [_percent(explanation.part(setting.share.value))] if is_clear else []
            others = (setting.alone, setting.last)
            cells += [signed(setting.share), *part]
            cells += [number(share.value, True) if share else "" for share in others]
        elif has_shares:
            cells += ["not in the set", "", "", ""]
        rows.append(tuple(cells))
    headings: tuple[str, ...] = ("setting", "A", "B")
    if not has_shares:
        return Section("Settings", [], [Grid(headings, rows)])
    text = (
        "A share is the effect of a setting, averaged over all orders in which the settings can be changed "
        "(Shapley value), with a 95 % bootstrap interval over seeds; the shares add up to the difference."
    )
    if explanation.method == "delta debugging":
        text = (
            "Delta debugging found settings that make the difference and of which none can be left out; "
            "others may do so, too. "
            f"{text.replace('the difference', 'what they make together')}"
        )
    headings += ("share", "of all", "alone", "last") if is_clear else ("share", "alone", "last")
    return Section("Shares", [text], [Grid(headings, rows)])


def _interactions_section(explanation: Explanation) -> Section:
    clear = explanation.clear_interactions
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
    setting_shares = [shares[name] for name in pair.settings]
    signs = {share.value > 0 for share in setting_shares if share is not None and share.excludes_zero}
    if len(signs) != 1:
        return "the effect of one depends on the other"
    return "stronger together" if signs == {pair.beyond.value > 0} else "weaker together"


def shown_mixtures(explanation: Explanation) -> list[Mixture]:
    """Return the mixtures, of many only A, each setting alone, all but one, B and the smallest set."""
    if len(explanation.mixtures) <= _MAX_MIXTURES:
        return list(explanation.mixtures)
    count = len(explanation.settings)
    counts = (0, 1, count - 1, count)
    return [
        mixture
        for mixture in explanation.mixtures
        if len(mixture.settings) in counts or mixture == explanation.smallest
    ]


def _mixtures_section(explanation: Explanation) -> Section:
    names = [setting.name for setting in explanation.settings]
    mixtures = shown_mixtures(explanation)
    rows = []
    for mixture in mixtures:
        sides = ("B" if name in mixture.settings else "A" for name in names)
        rows.append((number(mixture.mean.value), _interval(mixture.mean), *sides))
    text = f"{counted(explanation.runs, 'run')}, {len(explanation.mixtures)} mixtures of the settings"
    text += f"; {len(mixtures)} of them are listed." if len(mixtures) < len(explanation.mixtures) else "."
    if explanation.trained:
        text += f" {counted(explanation.trained, 'run')} trained now; {duration(explanation.seconds)} in all."
    return Section("Mixtures", [text], [Grid((explanation.metric, "95 %", *names), rows)])


def _percent(part: float) -> str:
    return f"{round(100 * part) or 0} %" if math.isfinite(part) else ""


def number(value: float, sign: bool = False) -> str:
    """Return a value with about four digits."""
    digits = 0 if abs(value) >= 1000 else 1 if abs(value) >= 10 else 2 if abs(value) >= 1 else 3
    return f"{value:+,.{digits}f}" if sign else f"{value:,.{digits}f}"


def _interval(estimate: Estimate) -> str:
    if math.isnan(estimate.low) or estimate.low == estimate.high:  # the same with every seed
        return ""
    return f"{number(estimate.low)} to {number(estimate.high)}"


def signed(estimate: Estimate) -> str:
    """Return a difference with its interval: `+21.3 (19.8 to 22.7)`."""
    interval = _interval(estimate)
    return number(estimate.value, True) + (f" ({interval})" if interval else "")


# --- as pictures ------------------------------------------------------------------------------------------


def drawn_sections(explanation: Explanation) -> list[Section]:
    """Return the text of an explanation, with its pictures after the first section."""
    first, *others = sections(explanation)
    return [first, Section("", figures=_figures(explanation)), *others]


def _figures(explanation: Explanation) -> list[Figure]:
    """Return shares, clear interactions, and mixtures by their value."""
    names = [setting.name for setting in explanation.settings]
    result = []
    shares = [(setting.name, setting.share) for setting in explanation.settings if setting.share is not None]
    if shares:
        title = f"Share of each setting in the difference of {explanation.metric}"
        result.append(Figure(bars_chart(title, shares).svg(), is_wide=True))
    pairs = [(" x ".join(pair.settings), pair.beyond) for pair in explanation.clear_interactions]
    if pairs:
        title = f"{explanation.metric}: what two settings do together beyond what each does"
        result.append(Figure(bars_chart(title, pairs).svg(), is_wide=True))
    columns = [
        BarColumn(mixture.settings, mixture.values, mixture == explanation.smallest)
        for mixture in sorted(shown_mixtures(explanation), key=lambda mixture: mixture.mean.value)
    ]
    title = f"{explanation.metric} of mixtures: a filled dot is the value of B, a hollow one that of A"
    result.append(Figure(mixtures_chart(title, names, columns).svg(), is_wide=True))
    return result


# --- on disk ------------------------------------------------------------------------------------------


def write_explanation(explanation: Explanation, recordings: Path) -> None:
    """Write a result next to what it was computed from."""
    path = recordings / FOLDER / f"{explanation.name}.json"
    with storage_errors(path), replacing(path) as fresh:
        fresh.write_text(json.dumps(explanation.as_json()), encoding="utf-8")


def explanations_in(recordings: Path) -> list[str]:
    """Return the names of the results in a recordings folder."""
    return sorted(f"{file.parent.name}/{file.stem}" for file in (recordings / FOLDER).glob("*/*.json"))


@dataclass(frozen=True)
class Trained:
    """The files and runs of an explanation, which may be removed."""

    name: str
    """The folder of the pair."""
    folder: Path
    files: tuple[Path, ...]
    runs: tuple[Removal, ...]
    """The short runs that show its first step."""

    @property
    def bytes(self) -> int:
        """The bytes that removing it frees; runs that are kept or in use stay."""
        result_bytes = sum(file.stat().st_size for file in self.files)
        return result_bytes + sum(run.freed for run in self.runs if not run.refusal)


def trained_in(recordings: Path) -> list[Trained]:
    """Return what explanations trained in a recordings folder."""
    runs = list_runs(recordings / UNLISTED)
    return [
        Trained(
            folder.name,
            folder,
            tuple(file for file in sorted(folder.iterdir()) if file.suffix in (".json", ".jsonl")),
            tuple(plan(run, run.folder.parent) for run in runs if TAG.format(folder.name) in run.tags),
        )
        for folder in sorted((recordings / FOLDER).glob("*"))
        if folder.is_dir() and not folder.is_symlink() and folder.name != UNLISTED.name
    ]


def remove_trained(trained: Trained) -> None:
    """Remove the files and runs of an explanation, except runs that are kept or in use."""
    lock = acquired(trained.folder / LOCK, RunnerError(f"{trained.name} is being computed; it stays."))
    try:
        for run in trained.runs:
            if not run.refusal:
                remove(run)
        with storage_errors(trained.folder):
            for file in trained.files:
                file.unlink(missing_ok=True)
    finally:
        lock.release()
    with contextlib.suppress(OSError):  # other files, or another process has begun to use it
        (trained.folder / LOCK).unlink(missing_ok=True)
        trained.folder.rmdir()


def read_explanation(name: str, recordings: Path) -> Explanation:
    """Return a result from its file.

    Raises:
        RunnerError: there is none of this name, or its file is damaged.
    """
    from pydantic import TypeAdapter

    explanations = explanations_in(recordings)
    if name not in explanations:
        raise RunnerError(f"no explanation {name!r} in {recordings}.{nearest(name, explanations)}")
    path = recordings / FOLDER / f"{name}.json"
    try:
        with open_regular(path) as file:
            content = file.read(_MAX_BYTES + 1)
        if len(content) > _MAX_BYTES:
            raise RunnerError(f"{path}: larger than {size(_MAX_BYTES)}, expected an explanation.")
        explanation = TypeAdapter(Explanation).validate_json(content)
        _check(explanation)
    except (OSError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise RunnerError(f"{path}: no longer describes an explanation ({reason}).") from error
    return explanation


def _check(explanation: Explanation) -> None:
    """Check what the types do not say, or raise a `ValueError`."""
    numbers = [
        explanation.difference.value,
        *(value for mixture in explanation.mixtures for value in mixture.values),
    ]
    numbers += [setting.share.value for setting in explanation.settings if setting.share is not None]
    numbers.append(explanation.seconds)
    counts = {len(mixture.values) for mixture in explanation.mixtures}
    known_settings = {setting.name for setting in explanation.settings}
    named = [mixture.settings for mixture in explanation.mixtures]
    named += [interaction.settings for interaction in explanation.interactions]
    if len(explanation.mixtures) < 2 or counts != {len(explanation.seeds)} or not explanation.seeds:
        raise ValueError("a mixture lacks values")
    if not all(math.isfinite(value) and abs(value) < _MAX_VALUE for value in numbers):
        raise ValueError("a value is not finite")
    if not all(known_settings.issuperset(names) for names in named):
        raise ValueError("a setting is missing")
