"""One grammar for references to steps, of commands and pages."""

from __future__ import annotations

import pytest

from runner.analysis.step_reference import parse_step_reference, step_reference
from runner.errors import RunnerError


@pytest.mark.parametrize(
    ("text", "step"),
    [
        ("120", (120, 0)),
        ("120:5", (120, 5)),
        ("eval:3000", (3000, 0, 0)),
        ("eval:3000:17", (3000, 17, 0)),
        ("eval:3000:17:5", (3000, 17, 5)),
    ],
)
def test_what_is_left_out_is_0(text, step):
    assert parse_step_reference(text) == step
    assert parse_step_reference(step_reference(step)) == step


@pytest.mark.parametrize(
    "text", ["", "x", "1:", ":5", "1:2:3", "eval:", "eval:1:2:3:4", "-1", "1_0", "٣", " 1"]
)
def test_anything_else_is_refused_with_what_is_expected(text):
    with pytest.raises(RunnerError, match="expected EPISODE:T such as 120:5, or eval:N:TRIAL:T"):
        parse_step_reference(text)
