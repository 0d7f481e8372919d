"""The queries of docs/archive.md, run over archives of several runs, as a reader would type them."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import duckdb
import pandas as pd
import polars as pl
import pyarrow.parquet as pq
import pytest

from runner.archive.writing import write_archive
from runner.recording import schema
from runner.recording.reader import open_recording
from tests.runner.recording.making import TAXIS, make_run

PAGE = (Path(__file__).parents[3] / "docs" / "archive.md").read_text(encoding="utf-8")
QUERIES = re.findall(r"\*\*(\d+)\..*?```(sql|python)(?: no-test)?\n(.*?)```", PAGE, flags=re.DOTALL)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Return runs of three kinds, archived side by side, and the folder that has `archive`."""
    folder = tmp_path_factory.mktemp("many")
    made = [
        make_run(folder / "recordings", TAXIS, mode="cooperative", seed=0),
        make_run(folder / "recordings", TAXIS, mode="cooperative", seed=1),
        make_run(folder / "recordings", TAXIS, seed=0),
    ]
    for run in made:
        (folder / "archive" / run.run_id).mkdir(parents=True)
        with open_recording(run.recording) as recording:
            write_archive(recording, folder / "archive" / run.run_id)
    return folder, made


def test_there_are_six():
    assert [int(number) for number, _, _ in QUERIES] == list(range(1, 7))


@pytest.mark.parametrize("number", [number for number, kind, _ in QUERIES if kind == "sql"])
def test_a_query_answers(number, runs, monkeypatch):
    folder, made = runs
    monkeypatch.chdir(folder)
    (text,) = [text for n, _, text in QUERIES if n == number]
    answer = duckdb.sql(text)
    rows = answer.fetchall()
    assert rows
    assert not any(value is None for row in rows for value in row)
    if "run_id" in answer.columns:
        column = answer.columns.index("run_id")
        assert {row[column] for row in rows} == {run.run_id for run in made}


@pytest.mark.parametrize("number", [number for number, kind, _ in QUERIES if kind == "python"])
def test_a_program_prints(number, runs):
    folder, _ = runs
    (text,) = [text for n, _, text in QUERIES if n == number]
    ran = subprocess.run(
        [sys.executable, "-c", text], cwd=folder, capture_output=True, text=True, check=False, timeout=120
    )
    assert ran.returncode == 0, ran.stderr
    assert len(ran.stdout.splitlines()) >= 3


def test_all_three_read_the_same_steps(runs, monkeypatch):
    folder, made = runs
    monkeypatch.chdir(folder)
    pattern = "archive/*/steps.parquet"
    table = f"read_parquet('{pattern}', union_by_name = true)"
    duck = duckdb.sql(f"SELECT run_id, count(*), sum(reward) FROM {table} GROUP BY 1").fetchall()
    by_run = {run_id: figures for run_id, *figures in duck}
    panda = pd.concat(pd.read_parquet(path) for path in folder.glob(pattern))
    polar = pl.scan_parquet(pattern, missing_columns="insert", extra_columns="ignore").collect()
    for run in made:
        with open_recording(run.recording) as recording:
            blocks = [
                block
                for topic in (schema.TRAIN_STEP, schema.EVAL_STEP)
                for block in recording.table(topic).blocks()
            ]
        expected = sum(map(len, blocks)), sum(float(block["rewards"].sum()) for block in blocks)
        assert tuple(by_run[run.run_id]) == pytest.approx(expected)
        mine = panda[panda["run_id"] == run.run_id]["reward"]
        assert (len(mine), mine.sum()) == pytest.approx(expected)
        ours = polar.filter(pl.col("run_id").cast(pl.String) == run.run_id)["reward"]
        assert (len(ours), ours.sum()) == pytest.approx(expected)


def test_a_step_is_found_by_the_columns_that_the_page_names(runs):
    folder, made = runs
    for name in ("steps", "episodes", "run", "q_tables", "log", "transitions", "states", "actions"):
        (row,) = [line for line in PAGE.splitlines() if line.startswith(f"| `{name}.parquet` |")]
        named = set(re.findall(r"`(\w+)`", row.rpartition("|")[0].rsplit("|", 1)[1])) - {"train", "eval"}
        columns = set(pq.read_schema(folder / "archive" / made[0].run_id / f"{name}.parquet").names)
        assert named <= columns
