"""Disk usage of runs: the largest ones, their sums, and what could be freed."""

from __future__ import annotations

from runner.recording.labels import Labels, change_labels
from runner.runs.catalogue import usage as usages
from runner.runs.catalogue.index import look
from runner.runs.run import create_run
from runner.util.files import CACHED_EXPORTS, CACHED_RECORDINGS
from tests.runner.runs.listed import ALL, CONFIG


def test_a_change_in_the_folder_of_a_run_is_measured(folder):
    run = create_run(folder, CONFIG, 1).update(status="finished")
    run.recording.write_bytes(bytes(1000))

    def used():
        (usage,), sums = usages.usage_of(lambda work: look([folder], work), ALL, 5)
        assert (sums.runs, sums.bytes["total"]) == (1, usage.bytes["total"])
        return usage.bytes["recording"], sums.freed["left_over"]

    assert used() == (1000, 0)
    (run.folder / "recording.damaged-1.mcap").write_bytes(bytes(50))
    assert used() == (1000, 50)
    run.recording.write_bytes(bytes(2000))
    assert used() == (2000, 50)


def test_the_largest_runs_come_first_and_the_sums_are_those_of_all(folder, tmp_path):
    digest = "ab" * 32
    runs = [create_run(folder, CONFIG, seed) for seed in range(6)]
    for seed, run in enumerate(runs):
        run.recording.write_bytes(bytes(10_000 * (seed + 1)))
        run.update(status="failed" if seed == 2 else "finished", summary={"content_digest": digest})
    (runs[3].folder / "recording.damaged-1.mcap").write_bytes(bytes(50))
    for seed in (3, 5):
        change_labels(runs[seed].folder, lambda _: Labels(tags=("keep", "other")))
    exports = tmp_path / "cache" / "dualtaxi" / CACHED_EXPORTS
    exports.mkdir(parents=True)
    (exports / f"{runs[0].run_id}-0123456789ab.rrd").write_bytes(bytes(1_000_000))

    def usage_with(limit):
        largest, sums = usages.usage_of(lambda work: look([folder], work), ALL, limit)
        return [(usage.row["id"], usage.row["same_as"], usage.bytes["total"]) for usage in largest], sums

    first, sums = usage_with(2)
    assert [run_id for run_id, _, _ in first] == [runs[0].run_id, runs[5].run_id]
    assert (sums.runs, sums.bytes["recording"], sums.bytes["exports"]) == (6, 210_000, 1_000_000)
    every, _ = usage_with(None)
    assert every[:2] == first
    assert sums.bytes["total"] == sum(total for _, _, total in every)
    copies = {run_id for run_id, same_as, _ in every if same_as}
    assert len(copies) == 5
    own = {run.run_id: usages.contents_of(run.folder).freed for run in runs}
    tagged = {runs[3].run_id, runs[5].run_id}
    assert sums.freed["same_content"] == sum(own[run_id] for run_id in copies - tagged)
    assert sums.freed["unfinished"] == own[runs[2].run_id]
    assert sums.freed["left_over"] == 0


def test_cached_files_count_for_their_run(folder, tmp_path):
    exports, restored = (
        tmp_path / "cache" / "dualtaxi" / part for part in (CACHED_EXPORTS, CACHED_RECORDINGS)
    )
    exports.mkdir(parents=True)
    restored.mkdir()
    (exports / "a-b-0123456789ab.rrd").write_bytes(bytes(1))
    (exports / "a+b-0123456789ab.rrd").write_bytes(bytes(10))
    (restored / "a-b-0123456789abcdef.mcap").write_bytes(bytes(100))
    (restored / "a.c-0123456789abcdef.mcap").write_bytes(bytes(1000))
    assert usages.cached(CACHED_EXPORTS) == {"a-b": 1, "a": 10}
    assert usages.cached(CACHED_RECORDINGS) == {"a-b": 100, "a.c": 1000}
