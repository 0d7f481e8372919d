"""The strategies of sweeps: a row of `STRATEGIES` each, from which everything else follows.

A strategy proposes values by a sampler of Optuna, asked for a batch at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Final

from pydantic import AfterValidator, Field

from runner.config.values import refusal
from runner.sweep.parameters import MAX_TRIALS, Parameter, Range, points_of

if TYPE_CHECKING:
    from optuna.samplers import BaseSampler


def _check_search(strategy: str, trials: int | None, _: Mapping[str, Parameter]) -> None:
    if trials is None:
        raise refusal(("trials",), f"missing, expected a whole number: {strategy} has no end")


def _check_grid(_: str, trials: int | None, parameters: Mapping[str, Parameter]) -> None:
    if trials is not None:
        raise refusal(("trials",), f"found {trials}, but a grid tries all of its points")
    for name, parameter in parameters.items():
        if isinstance(parameter, Range) and parameter.step is None and not parameter.is_integer:
            raise refusal(("parameters", name), "found a range without step: a grid needs one")
        if isinstance(parameter, Range) and parameter.log:
            raise refusal(("parameters", name, "log"), "found true, but a grid has steps")
    if points_of(parameters.values()) > MAX_TRIALS:
        message = (
            f"found a grid of more points than {MAX_TRIALS:,}: take larger steps, or a strategy that "
            "tries some of them"
        )
        raise refusal(("parameters",), message)


@dataclass(frozen=True)
class Strategy:
    """How the values of trials are found."""

    text: str
    """The values that it tries, for the help of the key `strategy` and the documentation."""
    sampler: Callable[[ModuleType, int, int], BaseSampler]
    """Returns the sampler, from the module `optuna.samplers`, the size of a batch and a seed of 32 bits."""
    check: Callable[[str, int | None, Mapping[str, Parameter]], None] = _check_search
    """Refuses a number of trials, or parameters, that do not fit the strategy, which has this name."""
    is_grid: bool = False
    """Whether it tries every point of a grid, rather than a number of trials."""
    is_adaptive: bool = True
    """Whether its suggestions depend on earlier results, so that it is asked for one batch at a time."""
    skips_repeats: bool = False
    """Whether it draws again what it suggested before, unless the sweep has `repeats`."""


STRATEGIES: Final = {
    "grid": Strategy(
        "all combinations",
        lambda samplers, _, seed: samplers.RandomSampler(seed=seed),  # its points are given to Optuna
        _check_grid,
        is_grid=True,
        is_adaptive=False,
    ),
    "random": Strategy(
        "`trials` combinations, drawn independently",
        lambda samplers, _, seed: samplers.RandomSampler(seed=seed),
        is_adaptive=False,
    ),
    "tpe": Strategy(
        "`trials` combinations, by a tree-structured Parzen estimator of good values",
        lambda samplers, batch, seed: samplers.TPESampler(seed=seed, n_startup_trials=2 * batch),
        skips_repeats=True,
    ),
    "genetic": Strategy(
        "`trials` combinations, by the genetic algorithm NSGA-II; a batch is a generation",
        lambda samplers, batch, seed: samplers.NSGAIISampler(population_size=max(2, batch), seed=seed),
    ),
}
"""By the name in a sweep's file."""


def _known(name: str) -> str:
    if name not in STRATEGIES:
        raise ValueError(name)  # reported by the choices of the schema
    return name


StrategyName = Annotated[str, AfterValidator(_known), Field(json_schema_extra={"enum": [*STRATEGIES]})]
"""The name of a strategy."""
