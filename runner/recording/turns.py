"""Rows of steps as turns of environments.

A vector steps its environments in rounds, each in its turn. At some turns it only resets an environment: the
row is no step then, and its `taken` is false. A recording of a single environment has no such columns.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from runner.util.arrays import Flags, Ints, Records


def is_taken(rows: Records) -> Flags:
    """Return which rows are steps, and not only resets."""
    if "taken" not in (rows.dtype.names or ()):
        return np.ones(rows.shape, np.bool_)
    return np.asarray(rows["taken"].view(np.uint8) > 0)  # a damaged file may hold any byte


def taken(rows: Records) -> Records:
    """Return the rows that are steps."""
    are_steps = is_taken(rows)
    return rows if are_steps.all() else rows[are_steps]


def is_of_environment(rows: Records, environment: int) -> Flags:
    """Return which rows are steps that an environment took: all where only one was recorded."""
    if "environment" not in (rows.dtype.names or ()):
        return is_taken(rows)
    is_step: Flags = rows["environment"] == environment
    is_step &= is_taken(rows)
    return is_step


def turns_of(rows: Records) -> Iterator[tuple[int, Ints]]:
    """Yield each environment that took steps, and the places of its steps among the rows."""
    places = np.flatnonzero(is_taken(rows))
    if "environment" not in (rows.dtype.names or ()):
        yield 0, places
        return
    environment = rows["environment"][places]
    order = np.argsort(environment, kind="stable")
    edges = np.flatnonzero(np.diff(environment[order])) + 1
    for steps in np.split(places[order], edges):
        if len(steps):
            yield int(rows["environment"][steps[0]]), steps
