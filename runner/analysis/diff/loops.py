"""Where two recordings part of which one is of somebody's own loop: by their bytes, field by field."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.analysis.diff.settings import EnvironmentDiff, changes_in
from runner.analysis.diff.trajectory import Parting
from runner.recording import schema
from runner.recording.blocks import HEADER
from runner.recording.messages import decode
from runner.recording.reader import Recording

MOST_NUMBERS: Final = 16
"""A value of more numbers is not told whole where it differs."""
_HEADER: Final = {name for name, _ in HEADER}


def loop_environment_diff(a: Recording, b: Recording) -> EnvironmentDiff:
    """Return how what is said of two environments and their spaces differs."""
    left, right = ({"spaces": _spaces(recording), **recording.environment} for recording in (a, b))
    return EnvironmentDiff(changes_in(left, right))


def _spaces(recording: Recording) -> dict[str, Any]:
    return {} if recording.is_job else recording.spaces


def comparable(a: Recording, b: Recording) -> bool:
    """Return whether the steps of both are in the same spaces."""
    both = {a.kind, b.kind}
    if both <= {"job", "step"}:
        return True
    return len(both) == 1 and a.spaces == b.spaces and a.agents == b.agents


def loop_parting(a: Recording, b: Recording, phase: str = "train") -> Parting | None:
    """Return the first step of a phase at which two loops part, and the first field of it that differs.

    If they part in what a reset observed, it is the step after it, and the field is `reset.observation`.
    """
    if a.topic(f"/{phase}/step") not in a.dtypes:
        return _message_parting(a, b, phase)
    parting = _step_parting(a, b, phase)
    if a.kind == "step":
        return parting  # a step has the state before it
    return _reset_parting(a, b, phase, math.inf if parting is None else parting.step) or parting


def _step_parting(a: Recording, b: Recording, phase: str) -> Parting | None:
    position = 0
    for left, right in _abreast(a, b, f"/{phase}/step"):
        if not (len(left) and len(right)):
            return _end(left, right, position, phase)
        row, name = _first_difference(left, right)
        if name:
            return _parting(left[row], right[row], name, phase)
        position += len(left)
    return None


def _reset_parting(a: Recording, b: Recording, phase: str, last: float) -> Parting | None:
    """Return where two loops part in what a reset observed, if that is before the end of the step `last`."""
    for left, right in _abreast(a, b, f"/{phase}/reset"):
        if not (len(left) and len(right)) or left["step"][0] > last:
            return None
        differs = _rows_differ(left["observation"], right["observation"])
        if not differs.any():
            continue
        one, other = (block[int(differs.argmax())] for block in (left, right))
        if one["step"] > last:
            return None
        part, mine, theirs = _part("reset.observation", one["observation"], other["observation"])
        step, episode = int(one["step"]), int(one["episode"])
        return Parting(phase, None, None, step, episode, 0, part, mine.tolist(), theirs.tolist(), None, None)
    return None


def _abreast(a: Recording, b: Recording, topic: str) -> Iterator[tuple[NDArray[Any], NDArray[Any]]]:
    """Yield the records of a topic of both, as many of each; last what one has more, beside nothing."""
    streams = [recording.blocks(recording.topic(topic)) for recording in (a, b)]
    left: NDArray[Any] = np.empty(0)
    right: NDArray[Any] = np.empty(0)
    while True:
        left, right = (
            block if len(block) else next(stream, block)
            for block, stream in zip((left, right), streams, strict=True)
        )
        n = min(len(left), len(right))
        if not n:
            yield left, right
            return
        yield left[:n], right[:n]
        left, right = left[n:], right[n:]


def _first_difference(left: NDArray[np.void], right: NDArray[np.void]) -> tuple[int, str]:
    """Return the first row in which two blocks differ, and the first field; no name if there is none."""
    names = [
        name
        for name in left.dtype.names or ()
        if name not in _HEADER and not name.startswith("tag_") and name in (right.dtype.names or ())
    ]
    differs = {name: _rows_differ(left[name], right[name]) for name in names}
    first = {name: int(np.argmax(rows)) for name, rows in differs.items() if rows.any()}
    if not first:
        return 0, ""
    row = min(first.values())
    return row, next(name for name, at in first.items() if at == row)


def _rows_differ(left: NDArray[Any], right: NDArray[Any]) -> NDArray[np.bool_]:
    one, other = (
        np.ascontiguousarray(values).reshape(len(values), -1).view(np.uint8) for values in (left, right)
    )
    if one.shape != other.shape:
        return np.ones(len(left), np.bool_)
    return np.asarray((one != other).any(axis=1))


def _end(left: NDArray[Any], right: NDArray[Any], position: int, phase: str) -> Parting | None:
    """Return the parting where one loop ends before the other; None if both end."""
    if not (len(left) or len(right)):
        return None
    step = left[0] if len(left) else right[0]
    a, b = ("one more" if len(block) else "none" for block in (left, right))
    return Parting(
        phase, None, None, position, int(step["episode"]), int(step["t"]), "step", a, b, None, None
    )


def _parting(left: np.void, right: np.void, name: str, phase: str) -> Parting:
    part, one, other = _part(name, left[name], right[name])
    return Parting(
        phase=phase,
        evaluation=None,
        after=None,
        step=int(left["step"]),
        episode=int(left["episode"]),
        t=int(left["t"]),
        field=part,
        a=one.tolist(),
        b=other.tolist(),
        a_step=left,
        b_step=right,
    )


def _part(name: str, one: Any, other: Any) -> tuple[str, Any, Any]:
    """Return the first part of a value that differs: of a Dict its entry, of many numbers the one."""
    for entry in one.dtype.names or ():
        if one[entry].tobytes() != other[entry].tobytes():
            return _part(f"{name}.{entry}", one[entry], other[entry])
    if one.size <= MOST_NUMBERS:
        return name, one, other
    rows = _rows_differ(one.reshape(-1), other.reshape(-1))
    place = np.unravel_index(int(rows.argmax()), one.shape)
    return f"{name}[{', '.join(map(str, place))}]", one[place], other[place]


def _message_parting(a: Recording, b: Recording, phase: str) -> Parting | None:
    """Return the parting of loops whose steps vary in size."""
    streams: list[Iterator[tuple[int, bytes]]] = [
        recording.messages(recording.topic(f"/{phase}/step")) for recording in (a, b)
    ]
    position = 0
    while True:
        left, right = (next(stream, None) for stream in streams)
        if left is None and right is None:
            return None
        if left is None or right is None or left[1] != right[1]:
            break
        position += 1
    steps = [{} if one is None else decode(schema.TRANSITION, one[1]) for one in (left, right)]
    some = steps[0] or steps[1]
    names = [name for name in some if steps[0].get(name) != steps[1].get(name)]
    name = names[0] if all(steps) and names else "step"
    told_a, told_b = (str(step.get(name, "none")) for step in steps)
    return Parting(phase, None, None, position, some["episode"], some["t"], name, told_a, told_b, None, None)


def parted_topics(a: Recording, b: Recording) -> list[str]:
    """Return the topics whose content differs, as both recordings' digests say, if they have them."""
    left, right = (recording.result.topic_digests for recording in (a, b))
    if not left or not right:
        return []
    return sorted(name for name in left.keys() | right.keys() if left.get(name) != right.get(name))


def loop_means(recording: Recording) -> dict[str, Any]:
    """Return the means over the training episodes of a recording."""
    episodes = length = 0
    paid = 0.0
    for block in recording.blocks(schema.TRAIN_EPISODE):
        episodes += len(block)
        length += int(block["length"].sum())
        paid += float(block["returns"].sum())
    if not episodes:
        return {}
    return {"mean_length": round(length / episodes, 3), "mean_return": round(paid / episodes, 3)}
