"""Charts of pages: well-formed, inside their frame, and with every extreme of a long line."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import numpy as np
import pytest

from runner.analysis.axes import EPISODES
from runner.analysis.groups import Curve, Panel, smoothed
from runner.analysis.statistics import Estimate
from runner.export.plots.chart import Scale
from runner.export.plots.comparisons import bars_chart
from runner.export.plots.curves import CurveStyle, not_drawn, panel_chart
from runner.recording.metrics import SHARES


def curve(values, group=0, line="", spread=0.0):
    values = np.array(values, np.float64)
    low, high = values - spread, values + spread
    return Curve(group, line, np.arange(len(values)) * 1.0, values, low, high, values[np.newaxis])


def numbers(path):
    return np.array(re.findall(r"(-?[\d.]+),(-?[\d.]+)", path), np.float64)


def lines_of(svg):
    """Return the points of the lines of a chart."""
    root = ElementTree.fromstring(svg)
    return [numbers(path.get("d")) for path in root.iter("path") if path.get("stroke-linejoin") == "round"]


@pytest.mark.parametrize(
    "curves",
    [
        [curve([0.0])],
        [curve([0.0, 0.0, 0.0])],
        [curve([-1e-9, 1e-9])],
        [curve([-15_000.0, 3.0, -4.0], spread=2.0), curve([1e12, 5.0, 7.0], group=1)],
        [curve([1.0, 2.0], line="<taxi & 1>"), curve([2.0, 1.0], line="taxi_2")],
    ],
    ids=["one point", "zero", "tiny", "huge", "markup"],
)
def test_a_chart_is_well_formed_and_its_lines_are_inside(curves):
    panel = Panel("mean_length", "A <title> & more", "steps", tuple(curves), EPISODES)
    svg = panel_chart(panel, 1 + max(each.group for each in curves)).svg()
    assert "nan" not in svg
    drawn = lines_of(svg)
    assert len(drawn) == len(curves)
    for points in drawn:
        assert ((points >= [49.9, 31.9]) & (points <= [280.1, 146.1])).all()


@pytest.mark.parametrize("log_x", [False, True])
@pytest.mark.parametrize("values", [[800.0, 90.0, 0.0, 0.0, 4.0, 0.0], [-3.0, 0.0, -2.0, -1.0], [5.0]])
def test_smoothed_and_logarithmic_lines_are_inside_with_the_values_faintly_behind(values, log_x):
    style = CurveStyle(lines=True, smooth=20, log_x=log_x, log_y=True)
    panel = Panel("event.pickup", "Pickups", "per trial", (curve(values, spread=1.0),), EPISODES)
    chart = panel_chart(panel, 1, style)
    is_log = max(values[1:] if log_x else values, default=0) > 0
    assert chart.y.log == (is_log or len(values) == 1)
    svg = chart.svg()
    assert "nan" not in svg
    assert "inf" not in svg
    drawn = lines_of(svg)
    for points in drawn:
        assert ((points >= [49.9, 31.9]) & (points <= [280.1, 146.1])).all()
    assert svg.count('opacity="0.35"') == 1
    note = not_drawn([panel], style)
    assert ("left out of “Pickups”" in note) == (len(values) > 1 and (log_x or chart.y.log))
    assert ("no value is positive in “Pickups”" in note) == (not chart.y.log)


def test_the_exponential_mean_has_its_memory_in_units_of_the_axis():
    step = np.concatenate([[0.0], np.ones(50)])
    sparse = smoothed(np.arange(51) * 2.0, step, 10.0)
    assert sparse[5] == pytest.approx(1 - np.exp(-1))
    dense_places = np.linspace(0, 100, 1001)
    dense = smoothed(dense_places, (dense_places > 0).astype(float), 10.0)
    assert dense[100] == pytest.approx(sparse[5])


def test_a_long_line_keeps_every_spike():
    values = np.sin(np.arange(20_000) / 3_000)
    values[7_777] = 9.0
    values[12_345] = -9.0
    (points,) = lines_of(
        panel_chart(Panel("mean_return", "Return", "reward", (curve(values),), EPISODES), 1).svg()
    )
    assert len(points) < 4_000
    assert points[:, 1].min() == pytest.approx(32.0 + 114 / 22, abs=0.2)
    assert points[:, 1].max() == pytest.approx(146.0 - 114 / 22, abs=0.2)
    assert (np.diff(points[:, 0]) >= 0).all()


def test_shares_are_stacked_up_to_the_top():
    panel = Panel(
        SHARES, "Shares", "percent", (curve([40.0, 10.0], line="-1"), curve([60.0, 90.0], line="5")), EPISODES
    )
    root = ElementTree.fromstring(panel_chart(panel, 1).svg())
    bands = [numbers(path.get("d")) for path in root.iter("path") if path.get("stroke") == "#ffffff"]
    assert [band[:, 1].min() for band in bands] == [pytest.approx(146 - 0.4 * 114, abs=0.1), 32.0]
    assert {text.text for text in root.iter("text")} >= {"reward of a step", "-1", "5"}


@pytest.mark.parametrize(
    ("low", "high", "log", "ticks"),
    [
        (0, 103, False, [0, 50, 100]),
        (-0.1, 1.1, False, [0, 0.5, 1]),
        (0, 0.024, False, [0, 0.005, 0.01, 0.015, 0.02]),
        (0.002, 500, True, [0.01, 0.1, 1, 10, 100]),
        (0.15, 0.9, True, [0.2, 0.5]),
        (1e-12, 1e12, True, [1e-12, 1e-7, 1e-2, 1e3, 1e8]),
    ],
)
def test_ticks_are_round_and_few(low, high, log, ticks):
    assert Scale(low, high, 0, 1, log).ticks == pytest.approx(ticks)


def test_pairs_with_a_long_name_can_be_told_apart():
    names = [f"mode + quirks.second_table_uses_first_action x {other}" for other in ("discount", "epsilon")]
    drawn = bars_chart("together", [(name, Estimate(1.0, 0.5, 1.5)) for name in names]).svg()
    assert "… x discount" in drawn
    assert "… x epsilon" in drawn
