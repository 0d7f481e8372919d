"""A field of `Step` is a column of archives, data frames and `diff`."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from runner.archive import layout
from runner.archive.batches import batch_of, records_of
from runner.archive.columns import Shape
from runner.recording import schema
from runner.recording.layout import blank_records, layout_of

NAMES = [field.name for field in schema.STEP.fields]


def test_each_field_has_a_place_among_the_columns_that_people_read():
    fields = (*schema.STEP.fields, *schema.AGENT_FIELDS, schema.ENVIRONMENT_OF_STEP, schema.TAKEN)
    assert {field.name for field in fields} | {"next_observation"} == set(schema.STEP_COLUMNS)


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


def test_no_two_fields_of_a_step_have_one_number():
    fields = (*schema.STEP.fields, *schema.AGENT_FIELDS, schema.ENVIRONMENT_OF_STEP, schema.TAKEN)
    numbers = [field.number for field in fields]
    assert sorted(set(numbers)) == sorted(numbers)
