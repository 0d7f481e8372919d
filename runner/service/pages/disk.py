"""What uses the disk, and what could be freed."""

from __future__ import annotations

from typing import Final

from fastapi import APIRouter, Request, Response

from runner.runs.catalogue.filters import Filter
from runner.runs.catalogue.usage import sizes, usage_of
from runner.service.dependencies import CatalogueOf, JobsOf, SettingsOf
from runner.service.pages.rendering import page

router = APIRouter(include_in_schema=False)

ROWS: Final = 50
FREED_BY: Final = {
    "same_content": ("Recorded before", "The same content is there already: `dualtaxi rm` removes runs."),
    "unfinished": (
        "Unfinished",
        "`dualtaxi prune --status interrupted --status failed`, if not to be resumed.",
    ),
    "left_over": ("Left over", "Damaged originals that a repair kept, and what interrupted commands left."),
    "cached": ("Cached", "Made again when needed."),
    "half_removed": ("Half removed", "The next `dualtaxi rm` or `prune` removes the rest."),
}


@router.get("/disk")
def disk(request: Request, catalogue: CatalogueOf, settings: SettingsOf, jobs: JobsOf) -> Response:
    """Show what uses the disk, and what could be freed."""
    largest, sums = usage_of(catalogue.read, Filter(None), ROWS)
    freeable = sums.freeable(settings.recordings)
    return page(
        request,
        "disk.html",
        total=sums.by_kind(),
        free=jobs.status().free_bytes,
        freeable=[(*FREED_BY[kind], size) for kind, size in freeable.items() if size],
        rows=[{"row": usage.row, "sizes": sizes([usage])} for usage in largest],
        left=sums.runs - len(largest),
    )
