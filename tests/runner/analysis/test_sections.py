"""Tables of sections: columns of numbers are aligned to the right, in text, Markdown and HTML alike."""

from __future__ import annotations

import pytest

from runner.analysis.sections import Grid, Section, html, markdown


@pytest.mark.parametrize(
    "cells",
    [
        ("1,500", "-2.5", "–"),
        ("+1.75 (-0.250 to 4.50)", "0.000 (0.000 to 0.000)"),
        ("[69.80, 77.70]", "[never, never]"),
        ("50.3 %", ""),
        ("0 / 0 / 20", "17:681", "3.05e+09"),
    ],
)
def test_numbers_intervals_and_unknown_values_are_numeric(cells):
    assert Grid(("x",), [(cell,) for cell in cells]).numeric == (True,)


@pytest.mark.parametrize(
    "cells", [("north", "3"), ("7s47kr6",), ("8a54ds5v",), ("taxi 1",), ("",), ("-3 x",)]
)
def test_names_ids_and_empty_columns_are_text(cells):
    assert Grid(("x",), [(cell,) for cell in cells]).numeric == (False,)


def test_markdown_keeps_the_signs_of_a_cell():
    (*_, row, _) = markdown([Section("", grids=[Grid(("path",), [(r"C:\|*",)])])])
    assert row == r"| C:\\\|\* |"


def test_markdown_and_html_align_columns_alike():
    made = [
        Section("A", grids=[Grid(("name", "value"), [("one", "1"), ("two", "-20")]), Grid(("none",), [])])
    ]
    assert "| --- | ---: |" in list(markdown(made))
    assert '<td style="text-align:left">one</td><td style="text-align:right">1</td>' in html(made)
