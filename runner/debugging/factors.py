"""The settings in which two configurations differ, and configurations in which they are mixed."""

from __future__ import annotations

import copy
import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Final

from runner.config import ConfigError, ExperimentConfig, from_mapping
from runner.config.model import LEARNERS, SECTION_OF
from runner.errors import EnvironmentNotUsable, RunnerError
from runner.runs.branches import training_branches
from runner.util.differences import Change
from runner.util.humanize import listed, setting
from runner.util.values import Json, JsonView

MAX_ALL: Final = 8
"""With more settings than this, not all mixtures are run."""
MAX_SETTINGS: Final = 12
_MEASURING: Final = ("evaluation", "log", "snapshots", "recording")
"""Sections that change what is measured and recorded, and not what is learned."""
_MIXED_INSIDE: Final = ("env", "env.kwargs", "quirks", *SECTION_OF)
"""Sections whose settings can differ one by one; the others are one setting each."""


@dataclass(frozen=True)
class Factor:
    """One setting that differs, or several that only make sense together."""

    name: str
    changes: tuple[Change, ...]
    """The values in A and B by path; None for a section that one of them does not have."""

    @property
    def a(self) -> str:
        """Its value in A as text."""
        return self._values("a")

    @property
    def b(self) -> str:
        """Its value in B as text."""
        return self._values("b")

    def _values(self, side: str) -> str:
        values = {change.path: getattr(change, side) for change in self.changes}
        learners = (values.get("tables"), values.get("rewards"))
        modes = [mode for mode, means in LEARNERS.items() if means == learners]
        if modes:
            del values["tables"], values["rewards"]
        texts = (_branches(value) if path == "branches" else setting(value) for path, value in values.items())
        return ", ".join([*modes, *texts])


@dataclass(frozen=True)
class Mixing:
    """Two configurations, and the settings in which they differ."""

    a: ExperimentConfig
    b: ExperimentConfig
    """The second, with the sections of A that only measure and record."""
    factors: tuple[Factor, ...]
    notes: tuple[str, ...]
    """What is not mixed, and what is mixed only together."""

    @property
    def everything(self) -> int:
        """The number of the mixture that is B."""
        return (1 << len(self.factors)) - 1

    def config(self, mixture: int) -> ExperimentConfig:
        """Return the configuration of a mixture: the values of B where its bits are 1, else those of A."""
        paths = [change.path for factor in self.chosen(mixture) for change in factor.changes]
        return from_mapping(_mixed(self.a.to_mapping(), self.b.to_mapping(), paths))

    def chosen(self, mixture: int) -> list[Factor]:
        """Return the settings that have the values of B in a mixture."""
        return [factor for i, factor in enumerate(self.factors) if mixture >> i & 1]

    def in_words(self, mixture: int) -> str:
        """Return what a mixture is, for errors."""
        names = ", ".join(factor.name for factor in self.chosen(mixture)) or "none"
        return f"the mixture with these settings of B: {names}"


def mix(a: ExperimentConfig, b: ExperimentConfig, at: int | None = None, exact: bool = False) -> Mixing:
    """Return the settings in which two experiments differ, grouped so that they can be mixed.

    They are compared after `at` training episodes, by default each at its own end; `exact` is whether
    evaluations need exact measures.

    Raises:
        RunnerError: they differ in no setting, in too many, or in settings that cannot be mixed; or one of
            them trains fewer episodes than `at`.
    """
    for name, config in (("A", a), ("B", b)):
        if at is not None and at > config.episodes:
            raise RunnerError(
                f"at: found {at:,}, but {name} trains {config.episodes:,} episodes: choose an episode that "
                "both reach."
            )
    ours, theirs = a.to_mapping(), b.to_mapping()
    notes: list[str] = []
    measuring = [key for key in _MEASURING if ours[key] != theirs[key]]
    if measuring:
        notes.append(f"{listed(measuring)} only measure and record: those of A are used in all mixtures")
    if ours["evaluation"] is None:
        ours["evaluation"] = theirs["evaluation"] or {"every": 1000, "trials": 200}
        notes.append("A has no evaluation: that of B is used, or else one of 200 trials")
    ours["evaluation"] |= {"exact": True} if exact else {}
    shared = {key: ours[key] for key in (*_MEASURING, "name", "seeds")}
    shared |= {"episodes": at} if at is not None else {}
    a, b = (from_mapping(values | shared) for values in (ours, theirs))
    factors = [Factor(change.path, (change,)) for change in _changes(a.to_mapping(), b.to_mapping())]
    if not factors:
        same = f" ({'; '.join(notes)})" if notes else ""
        raise RunnerError(
            f"A and B differ in no setting that changes what is learned{same}: there is nothing to explain. "
            "`dualtaxi diff` compares two runs in everything else."
        )
    mixing = _grouped(Mixing(a, b, tuple(factors), tuple(notes)))
    if len(mixing.factors) > MAX_SETTINGS:
        names = ", ".join(factor.name for factor in mixing.factors)
        raise RunnerError(
            f"A and B differ in {len(mixing.factors)} settings, expected at most {MAX_SETTINGS}: {names}. "
            "Explain in two steps, by a configuration that has some of the settings of each."
        )
    return mixing


def _changes(a: JsonView, b: JsonView, prefix: str = "") -> Iterator[Change]:
    """Yield the settings that differ; sections in which values can be mixed one by one are entered."""
    for key in dict.fromkeys([*a, *b]):
        path = f"{prefix}{key}"
        left = a.get(key)
        right = b.get(key)
        if left == right:
            continue
        if (
            path in _MIXED_INSIDE
            and isinstance(left, Mapping)
            and isinstance(right, Mapping)
            and not (path == "env" and left["id"] != right["id"])
        ):
            yield from _changes(left, right, f"{path}.")
        else:
            yield Change(path, left, right)


def _mixed(a: Json, b: JsonView, paths: Sequence[str]) -> Json:
    """Return the values of A with those of B at some paths; a key that B does not have is removed."""
    mixed = copy.deepcopy(a)
    for path in paths:
        *sections, key = path.split(".") if path.count(".") < 2 else path.split(".", 2)
        here, there = mixed, b
        for section in sections:
            here, there = here[section], there[section]
        if key in there:
            here[key] = there[key]
        else:
            here.pop(key, None)
    return mixed


def _grouped(mixing: Mixing) -> Mixing:
    """Return the mixing with settings merged until each of its mixtures is valid."""
    notes = list(mixing.notes)
    for mixture in (0, mixing.everything):
        if problem := _problem(mixing, mixture):
            raise problem
    while len(mixing.factors) > 1:
        count = len(mixing.factors)
        checked = range(2**count) if count <= MAX_SETTINGS else _outer(count)
        wrong = next((mixture for mixture in checked if _problem(mixing, mixture)), None)
        if wrong is None:
            break
        i, j = _conflict(mixing, wrong)
        one, other = (mixing.factors[k] for k in sorted((i, j)))
        changes = one.changes + other.changes
        name = f"{one.name} + {other.name}"
        merged = Factor("mode" if name == "tables + rewards" else name, changes)
        reason = str(_problem(mixing, wrong)).splitlines()[-1]
        notes.append(f"{one.name} and {other.name} only go together, and count as one setting ({reason})")
        rest = [factor for factor in mixing.factors if factor not in (one, other)]
        mixing = Mixing(mixing.a, mixing.b, (merged, *rest), tuple(notes))
    return mixing


def _conflict(mixing: Mixing, wrong: int) -> tuple[int, int]:
    """Return two settings to merge: one of B and one of A, without either of which a mixture is valid."""
    numbers = range(len(mixing.factors))
    pairs = [(i, j) for i in numbers for j in numbers if wrong >> i & 1 and not wrong >> j & 1]

    def mended(pair: tuple[int, int]) -> int:
        tried = wrong | 1 << pair[1], wrong & ~(1 << pair[0])
        return sum(_problem(mixing, mixture) is None for mixture in tried)

    return max(pairs, key=mended)


def _outer(count: int) -> Iterator[int]:
    """Yield the mixtures in which at most two settings differ from the others."""
    for chosen in itertools.chain(*(itertools.combinations(range(count), size) for size in (1, 2))):
        mixture = sum(1 << i for i in chosen)
        yield from (mixture, 2**count - 1 - mixture)


def _problem(mixing: Mixing, mixture: int) -> RunnerError | None:
    """Return why a mixture cannot be run; None if it can."""
    try:
        config = mixing.config(mixture)
    except ConfigError as error:
        return error
    kwargs = json.dumps(config.to_mapping()["env"]["kwargs"], sort_keys=True)
    try:
        _require_environment(config.env.id, kwargs, config.rewards)
    except (ConfigError, EnvironmentNotUsable) as error:
        return error
    return None


@cache
def _require_environment(env_id: str, kwargs: str, rewards: str) -> None:
    from runner.environments.loading import load_mdp

    load_mdp(env_id, json.loads(kwargs), rewards)


def _branches(value: object) -> str:
    """Return branches of training in a few words: `epsilon 0.5 from step 100,000`."""
    texts = (
        f"{branch.changes} {'from' if branch.settings else 'at'} step {branch.step:,}"
        for branch in training_branches({"branches": value})
    )
    return "; ".join(texts) or "none"
