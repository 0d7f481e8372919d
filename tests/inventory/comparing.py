"""Compares the forms that were found with the inventory, and writes the inventory."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from tests.inventory.reading import Lines

FOLDER: Final = Path(__file__).parent
GONE: Final = FOLDER / "gone.txt"
"""What was removed on purpose: patterns `FORM` or `FORM: LINE`, `*` for any text, each below its reason."""
MAX_LINES: Final = 12
"""Lines of one form that are reported; a page that fails has nothing of what it had."""
ADVICE: Final = """\
What goes on purpose is named in tests/inventory/gone.txt, as `FORM: LINE` (`*` stands for any text) below a
comment that says why, and in CHANGELOG.md. Then `.venv/bin/python -m tests.inventory --write` takes it out of
the inventory and adds what is new."""

Item = tuple[str, str]
"""A form and one of its lines; the form itself has the line ''."""


def differences(kept: Lines, found: Lines, gone: re.Pattern[str]) -> list[str]:
    """Return a message for each line that is missing, new, or present although `gone` names it."""
    before, now = _items(kept), _items(found)
    missing = [item for item in before if item not in now and not _is_gone(item, gone)]
    still = [item for item in now if _is_gone(item, gone)]
    new = [item for item in now if item not in before]
    return [
        *_messages("missing", missing),
        *_messages("new", new),
        *_messages("still there, although gone.txt names it", still),
    ]


def _items(lines: Lines) -> dict[Item, None]:
    """Return the items in order, as the keys of a dictionary."""
    return dict.fromkeys((form, line) for form, inner in lines.items() for line in ("", *inner))


def _is_gone(item: Item, gone: re.Pattern[str]) -> bool:
    form, line = item
    return bool(gone.fullmatch(form) or gone.fullmatch(f"{form}: {line}"))


def _messages(what: str, items: list[Item]) -> Iterator[str]:
    """Yield a message for each form, line of several forms, and other line."""
    forms = {form for form, line in items if not line}
    by_line: dict[str, list[str]] = {}
    for form, line in items:
        if form not in forms:
            by_line.setdefault(line, []).append(form)
    for form in sorted(forms):
        yield f"{what}: {form} ({sum(form == each for each, _ in items) - 1} lines)"
    reported: Counter[str] = Counter()
    for line, those in by_line.items():
        reported[those[0]] += 1
        if reported[those[0]] <= MAX_LINES:
            others = f" (and in {len(those) - 1} more, such as {those[-1]})" if len(those) > 1 else ""
            yield f"{what}: {those[0]}: {line}{others}"
    for form, number in reported.items():
        if number > MAX_LINES:
            yield f"{what}: {form}: {number - MAX_LINES} more lines"


def gone_pattern() -> re.Pattern[str]:
    """Return the pattern of all that may be missing; one by one, two hundred patterns take half a minute."""
    texts = [text for text in GONE.read_text(encoding="utf-8").splitlines() if text and text[0] != "#"]
    return re.compile("|".join(re.escape(text).replace(r"\*", ".*") for text in texts))


def read(name: str) -> Lines:
    """Return the forms of a file of the inventory; there may be no such file yet.

    A form may stand there twice, as after a merge.
    """
    lines: Lines = {}
    file, form = FOLDER / name, ""
    for text in file.read_text(encoding="utf-8").splitlines() if file.exists() else ():
        if text.startswith("    "):
            lines[form].append(text[4:])
        elif text:
            form = text
            lines.setdefault(form, [])
    return lines


def write(name: str, found: Lines, gone: re.Pattern[str]) -> None:
    """Write a file of the inventory: what was found, and what is missing but not named as gone.

    A form stands in a line, its lines indented below it, all sorted: changes by several people merge.
    """
    items = [*_items(found), *(item for item in _items(read(name)) if not _is_gone(item, gone))]
    texts = [f"    {line}" if line else form for form, line in sorted({*items})]
    (FOLDER / name).write_text("".join(f"{text}\n" for text in texts), encoding="utf-8")
