"""The examples of docs/integrations.md run, and each records a run."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path

import pytest

import runner

PAGE = Path(__file__).parents[2] / "docs" / "integrations.md"
_EXAMPLE = re.compile(r"^```python integration[ \t]*\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def examples() -> list[tuple[str, str]]:
    """Return the heading and the text of each example."""
    sections = re.split(r"^## ", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]
    return [(text.partition("\n")[0], found) for text in sections for found in _EXAMPLE.findall(text)]


@pytest.mark.parametrize("text", [pytest.param(text, id=heading) for heading, text in examples()])
def test_an_example_of_the_page_records_a_run(text, recordings):
    with contextlib.redirect_stdout(io.StringIO()):
        exec(compile(text, str(PAGE), "exec"), {"__name__": "example"})
    runs = runner.list_runs(recordings)
    assert runs
    assert {run.facts["status"] for run in runs} == {"finished"}
    assert all(run.summary["train_steps"] > 0 for run in runs)
