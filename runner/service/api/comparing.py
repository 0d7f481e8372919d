"""Comparisons: the differences between two runs, and groups of runs with statistics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Final

from fastapi import APIRouter, Query, Response
from fastapi import Path as InPath
from pydantic import Field
from starlette.concurrency import run_in_threadpool

from runner.debugging.explanation import Explanation
from runner.debugging.explanation_files import explanations_in, read_explanation
from runner.errors import RunNotFound
from runner.runs.run import Run
from runner.service.api.reading import SVG
from runner.service.catalogue import Catalogue
from runner.service.curves import CurveOptions, Curves, FigureOptions, curves_of, figure_of
from runner.service.dependencies import CatalogueOf, ComputationOf, SettingsOf, recorded_run
from runner.service.problems import media_docs
from runner.service.settings import ServiceSettings
from runner.util.values import finite

router = APIRouter(
    tags=["comparing"],
)
CSV: Final = "text/csv"
MAX_RUNS: Final = 1000
RunNames = Annotated[
    tuple[str, ...], Field(min_length=1, max_length=MAX_RUNS, description="A run; may be repeated.")
]
RunName = Annotated[
    str, Field(max_length=200, description="A run: its id, the beginning of it, its name, ...")
]
Part = Annotated[str, InPath(max_length=120)]


class CurvesOfRuns(CurveOptions, frozen=True):
    """Runs, and the options of their curves."""

    run: RunNames
    lines: bool = Field(False, description="Include the single runs of each curve.")


class FigureOfRuns(FigureOptions, frozen=True):
    """Runs, and the options of their figure."""

    run: RunNames


@router.get("/explanations", summary="The names of the explanations that `dualtaxi explain` left.")
def explanations(settings: SettingsOf) -> list[str]:
    """Return names, each of a pair and a metric: `A-B-1f2e3d4c/success_percent`."""
    return [name for folder in settings.recordings for name in explanations_in(folder)]


@router.get("/explanations/{pair}/{metric}", summary="An explanation.")
def explanation(pair: Part, metric: Part, settings: SettingsOf) -> dict[str, object]:
    """Return what `dualtaxi explain --json` printed; null where there is no interval."""
    values: dict[str, object] = finite(found_explanation(pair, metric, settings).as_json())
    return values


def found_explanation(pair: str, metric: str, settings: ServiceSettings) -> Explanation:
    """Return an explanation in the recordings folders.

    Raises:
        RunNotFound: there is none.
    """
    name = f"{pair}/{metric}"
    folder = next((folder for folder in settings.recordings if name in explanations_in(folder)), None)
    if folder is None:
        raise RunNotFound(f"no explanation {name!r}: the page of sweeps lists those there are.")
    return read_explanation(name, folder)


@router.get("/curves", response_model=Curves, summary="The curves of several runs, seeds as one curve.")
async def curves(
    catalogue: CatalogueOf, compute: ComputationOf, options: Annotated[CurvesOfRuns, Query()]
) -> Response:
    """Return every metric over an axis, runs that differ in nothing but the seed as one curve with a band."""
    paths = [run.recording for run in await run_in_threadpool(found_runs, catalogue, options.run)]
    return await compute.json(curves_of, paths, options, options.lines)


@router.get(
    "/curves.csv",
    response_class=Response,
    responses=media_docs(CSV),
    summary="The points of the curves of several runs.",
)
async def curves_table(
    catalogue: CatalogueOf, compute: ComputationOf, options: Annotated[CurvesOfRuns, Query()]
) -> Response:
    """Return the curves as a table: the axis, and each curve with its band and its runs."""
    paths = [run.recording for run in await run_in_threadpool(found_runs, catalogue, options.run)]
    return Response(await compute(curves_of, paths, options, options.lines, True), media_type=CSV)


@router.get(
    "/curves.svg",
    response_class=Response,
    responses=media_docs(SVG),
    summary="The curves of several runs in one figure.",
)
async def curves_picture(
    catalogue: CatalogueOf, compute: ComputationOf, options: Annotated[FigureOfRuns, Query()]
) -> Response:
    """Return the figure that `dualtaxi plot` draws, of some metrics or all."""
    paths = [run.recording for run in await run_in_threadpool(found_runs, catalogue, options.run)]
    return Response(await compute(figure_of, paths, options), media_type=SVG)


def found_runs(catalogue: Catalogue, names: Sequence[str], several: bool = False) -> list[Run]:
    """Return the runs of some names, their recordings restored if they are archived.

    With `several`, a name means all runs of that name, each once.
    """
    if several:
        by_folder = {run.folder: run for name in names for run in catalogue.find_all(name)}
        return [recorded_run(run) for run in by_folder.values()]
    return [recorded_run(catalogue.find(name)) for name in names]
