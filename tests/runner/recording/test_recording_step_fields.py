"""A field of `Step` is compared, in data frames and archived: where one is forgotten, a test says where."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from runner.analysis import frames
from runner.analysis.diff import divergence
from runner.archive import layout
from runner.archive.columns import Shape
from runner.archive.rows import batch_of, records_of
from runner.recording import schema
from runner.recording.blocks import blank_records
from runner.recording.layout import layout_of

NAMES = [field.name for field in schema.STEP.fields]


@pytest.mark.parametrize("name", [name for name in NAMES if name != "step"])
def test_diff_compares_it(name):
    assert name in divergence.FIELDS


@pytest.mark.parametrize("name", [name for name in NAMES if name != "rewards"])
def test_a_data_frame_has_it(name):
    assert name in (*frames._BEFORE, *frames._AFTER)


@pytest.mark.parametrize("name", NAMES)
def test_an_archive_keeps_it(name):
    run = {"kind": "job", "learners": "1", "events": "0"}
    job = layout_of("job", 1, 0)
    shape = Shape(
        SimpleNamespace(
            path="a recording",
            run_id="k3v9m2xq",
            agents=("agency",),
            topics=job.topics,
            layout=job,
            tabular=False,
            has_states=True,
            spaces={"action": {"n": 1}},
            run=run,
        )
    )
    records = blank_records(schema.TRAIN_STEP, job.message(schema.TRAIN_STEP), 1)
    records[name] = 1
    table = shape.tables[layout.STEPS]
    batch = batch_of(table, schema.TRAIN_STEP, records, shape)
    ((_, restored),) = records_of(table, schema.TRAIN_STEP, batch, shape)
    assert restored.tobytes() == records.tobytes()
