"""`diff` of evaluations, also of those that a repair lost."""

from __future__ import annotations

import pytest

from runner.analysis.diff import diff
from runner.recording import schema
from runner.recording.reader import open_recording
from runner.replay.tables import tables_at
from tests.runner.altering import altered, without_chunk, without_digest


@pytest.fixture
def lossy(record, tmp_path):
    """The base run with the metrics of its second evaluation lost, and the base run itself."""
    path = tmp_path / "lossy.mcap"
    path.write_bytes(record().read_bytes())
    assert without_chunk(path, schema.EVAL_METRICS_TOPIC, 1) == 1
    with open_recording(path) as damaged, open_recording(record()) as whole:
        yield damaged, whole


def test_lost_metrics_of_an_evaluation_shift_no_others(lossy):
    for pair in (lossy, lossy[::-1]):
        difference = diff(*pair)
        assert difference.divergence is None
        assert difference.evaluation_divergence is None
        assert any("lost parts of evaluations" in note for note in difference.notes)


def test_an_evaluation_after_a_lost_one_is_compared_with_its_own_tables(lossy, record, tmp_path):
    def change(records):
        records["action"][records["episode"] == 24] ^= 1  # trial 4 of the third evaluation
        return records

    damaged, _ = lossy
    forged = altered(record(), tmp_path / "forged.mcap", schema.EVAL_STEP, change, result=without_digest)
    with open_recording(forged) as other:
        difference = diff(damaged, other)
    divergence, cause = difference.evaluation_divergence, difference.evaluation_cause
    assert (divergence.evaluation, divergence.after, divergence.episode, divergence.t) == (2, 120, 4, 0)
    trained = damaged.eval.all_metrics()[-1]["step"]
    state = int(divergence.a_step["state"])
    assert cause.rows[0].a == tables_at(damaged, trained)[0][state].tolist()


def test_evaluations_of_other_numbers_are_compared_by_trial(record):
    with open_recording(record()) as a, open_recording(record("evaluation.every=40")) as b:
        divergence = diff(a, b).evaluation_divergence
    assert divergence is not None
    assert divergence.after == 120
    assert divergence.field not in ("episode", "step")


def test_lost_trials_leave_out_their_evaluation_alone(record, tmp_path):
    def change(records):
        records["action"][records["episode"] == 24] ^= 1
        return records

    forged = altered(record(), tmp_path / "forged.mcap", schema.EVAL_STEP, change, result=without_digest)
    path = tmp_path / "lossy.mcap"
    path.write_bytes(record().read_bytes())
    without_chunk(path, schema.EVAL_STEP, 0)
    with open_recording(path) as damaged, open_recording(forged) as other:
        divergence = diff(damaged, other).evaluation_divergence
    assert (divergence.after, divergence.episode) == (120, 4)
