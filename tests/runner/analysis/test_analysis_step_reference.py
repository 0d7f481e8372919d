"""One grammar for references to steps, of commands and pages."""

from __future__ import annotations

import pytest

from runner.analysis.step_reference import StepRef, parse_step
from runner.errors import RunnerError


@pytest.mark.parametrize(
    ("text", "step"),
    [
        ("120", StepRef(120)),
        ("120:5", StepRef(120, 5)),
        ("eval:3000", StepRef(0, after=3000)),
        ("eval:3000:17", StepRef(17, after=3000)),
        ("eval:3000:17:5", StepRef(17, 5, 3000)),
    ],
)
def test_what_is_left_out_is_0(text, step):
    assert StepRef.parse(text) == step
    assert StepRef.parse(str(step)) == step


def test_a_training_step_by_its_number_is_named_as_such():
    assert parse_step("step:120") == 120
    assert parse_step("120") == StepRef(120)


@pytest.mark.parametrize(
    "text",
    ["", "x", "step:", "step:1:2", "1:", ":5", "1:2:3", "eval:", "eval:1:2:3:4", "-1", "1_0", "٣", " 1"],
)
def test_anything_else_is_refused_with_what_is_expected(text):
    with pytest.raises(RunnerError, match="expected EPISODE:T such as 120:5, or eval:N:TRIAL:T"):
        StepRef.parse(text)
    with pytest.raises(RunnerError, match=r"EPISODE:T .*, step:N, or eval:N:TRIAL:T"):
        parse_step(text)
