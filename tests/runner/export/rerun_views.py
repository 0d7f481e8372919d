"""The views of an export for Rerun, read back."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rerun.chunk import RrdReader


def views_of(path: Path) -> dict[str, list[str]]:
    """Return the entities of each view of an export, by its title."""
    return dict(_of_views(path, "ViewContents:query"))


def shown_ranges(path: Path) -> dict[str, tuple[int, int]]:
    """Return the range of time that each view of an export shows, by its title."""
    ranges = _of_views(path, "TimeAxis:view_range")
    return {title: (shown[0]["start"], shown[0]["end"]) for title, shown in ranges}


def _of_views(path: Path, component: str) -> Iterator[tuple[str, Any]]:
    """Yield the title and a component of each view that has it."""
    reader = RrdReader(str(path))
    titles, values = {}, {}
    for chunk in reader.stream(store=reader.blueprints()[0]).to_chunks():
        columns = chunk.to_record_batch().to_pydict()
        view = str(chunk.entity_path).removeprefix("/view/").partition("/")[0]
        if "ViewBlueprint:display_name" in columns:
            titles[view] = columns["ViewBlueprint:display_name"][0][0]
        if component in columns:
            values[view] = columns[component][0]
    for view, value in values.items():
        yield titles[view], value
