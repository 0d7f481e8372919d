"""A field of `Step` is compared, in data frames and archived: where one is forgotten, a test says where."""

from __future__ import annotations

import pytest

from runner.analysis import frames
from runner.analysis.diff import divergence
from runner.archive.columns import Shape, checked_batch
from runner.recording import schema
from runner.recording.blocks import blank_records, record_dtype

NAMES = [field.name for field in schema.STEP.fields]


@pytest.mark.parametrize("name", [name for name in NAMES if name != "step"])
def test_diff_compares_it(name):
    assert name in divergence.FIELDS


@pytest.mark.parametrize("name", [name for name in NAMES if name != "rewards"])
def test_a_data_frame_has_it(name):
    assert name in (*frames._BEFORE, *frames._AFTER)


@pytest.mark.parametrize("name", NAMES)
def test_an_archive_keeps_it(name):
    dtype = record_dtype(schema.STEP, 1)
    shape = Shape("k3v9m2xq", "job", ("agency",), ("a", "b"), (6, 6), (), {schema.TRAIN_STEP: dtype})
    records = blank_records(schema.TRAIN_STEP, dtype, 1)
    records[name] = 1
    assert checked_batch(schema.TRAIN_STEP, records, shape, "a recording").num_rows == 1
