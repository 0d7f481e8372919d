"""Archives in object storage, against a server on this machine that speaks S3."""

from __future__ import annotations

import json
import shutil

import pytest
from click.testing import CliRunner
from moto.server import ThreadedMotoServer
from pyarrow import fs
from pyarrow import parquet as pq

import runner
from runner.archive import layout
from runner.archive.layout import Manifest, entries_of
from runner.archive.reading import restore
from runner.archive.runs import archive_run
from runner.archive.store import ArchiveStore
from runner.cli import cli
from runner.errors import RecordingError, RunnerError, StorageError
from runner.runs.resolve import find_run

pytestmark = [
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
]
URL = "s3://lab/runs"


@pytest.fixture(scope="module")
def server():
    """Return the endpoint of an S3 server on loopback."""
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    yield f"http://{host}:{port}"
    server.stop()


@pytest.fixture
def bucket(server, monkeypatch):
    """Return a file system of that server; `lab` is an empty bucket."""
    for name, value in {
        "AWS_ENDPOINT_URL": server,
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_DEFAULT_REGION": "us-east-1",
    }.items():
        monkeypatch.setenv(name, value)
    files = fs.S3FileSystem(endpoint_override=server, allow_bucket_creation=True)
    files.create_dir("lab")
    yield files
    files.delete_dir_contents("lab")


def keys(bucket):
    found = bucket.get_file_info(fs.FileSelector("lab", recursive=True))
    return {info.path.removeprefix("lab/") for info in found if info.type == fs.FileType.File}


def put(bucket, key, data):
    with bucket.open_output_stream(f"lab/{key}") as stream:
        stream.write(data)


def store_copy(archive, run_id):
    """Store a copy of an archive's folder."""
    with ArchiveStore(URL).writing(run_id) as folder:
        shutil.copytree(archive, folder, dirs_exist_ok=True)


class CutOff:
    """A file system whose connection breaks when it has written some bytes of the nth file."""

    def __init__(self, files, fail_at):
        self._files, self._left = files, fail_at

    def __getattr__(self, name):
        return getattr(self._files, name)

    def open_output_stream(self, path, **options):
        self._left -= 1
        stream = self._files.open_output_stream(path, **options)
        if self._left == 0:
            stream.write(b"half of it")
            stream.close()
            raise OSError("the connection is gone")
        return stream


def test_a_run_goes_there_and_comes_back(run, bucket, tmp_path):
    recordings = shutil.copytree(run.folder.parent, tmp_path / "recordings")

    def command(*words):
        result = CliRunner().invoke(cli, [*words, "--recordings", str(recordings)])
        assert result.exit_code == 0, result.output
        return result

    result = json.loads(command("archive", run.run_id, "--to", URL, "--remove", "--json").stdout)
    assert result["place"] == f"{URL}/{run.run_id}"
    assert find_run(run.run_id, recordings).status == "archived"
    manifest = ArchiveStore(URL).manifest(run.run_id)
    assert keys(bucket) == {f"runs/{run.run_id}/{name}" for name in (*manifest.files, layout.MANIFEST)}
    command("restore", run.run_id)
    assert find_run(run.run_id, recordings).summary["content_digest"] == result["content_digest"]
    shutil.rmtree(recordings)
    command("restore", f"{URL}/{run.run_id}")
    command("verify", run.run_id)


def test_sql_reads_groups_of_rows_there(run, bucket, tmp_path, monkeypatch):
    recordings = shutil.copytree(run.folder.parent, tmp_path / "recordings")
    query = "SELECT * FROM steps WHERE phase = 'train' AND episode = 7 ORDER BY step"
    expected = runner.sql(query, recordings=recordings).arrow()
    monkeypatch.setattr("runner.archive.writing.ROWS_A_GROUP", 500)
    archive_run(find_run(run.run_id, recordings), URL, remove=True)
    groups, downloaded = [], []
    read, download = pq.ParquetFile.iter_batches, ArchiveStore._download

    def counted(file, *args, row_groups, **options):
        groups.append((len(row_groups), file.num_row_groups))
        return read(file, *args, row_groups=row_groups, **options)

    def named(store, run_id, name, *more):
        downloaded.append(name)
        return download(store, run_id, name, *more)

    monkeypatch.setattr(pq.ParquetFile, "iter_batches", counted)
    monkeypatch.setattr(ArchiveStore, "_download", named)
    assert runner.sql(query, recordings=recordings).arrow() == expected
    ((wanted, total),) = groups
    assert wanted < total
    assert not [name for name in downloaded if name.endswith(".parquet")]
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    result = runner.sql("SELECT count(*) AS n FROM steps", recordings=recordings)
    assert result.arrow().to_pylist() == [{"n": 0}]
    assert "cannot be accessed" in result.left_out[0]


@pytest.mark.parametrize("fail_at", [1, 3, -1], ids=["first file", "third file", "manifest"])
def test_an_interrupted_upload_leaves_no_archive_and_is_repeated(archive, bucket, monkeypatch, fail_at):
    files = len(entries_of(archive)) + 1
    with monkeypatch.context() as patched:
        patched.setattr(fs, "S3FileSystem", lambda **_: CutOff(bucket, fail_at % (files + 1)))
        with pytest.raises(StorageError, match=r"the connection is gone.*uploads all of it again"):
            store_copy(archive, "k3v9m2xq")
    if fail_at != -1:
        assert ArchiveStore(URL).manifest("k3v9m2xq") is None
    else:
        with pytest.raises(RecordingError, match="is not the manifest of an archive"):
            ArchiveStore(URL).manifest("k3v9m2xq")
    store_copy(archive, "k3v9m2xq")
    with ArchiveStore(URL).reading("k3v9m2xq") as folder:
        restore(folder)


def test_files_of_several_parts(bucket, tmp_path):
    folder = tmp_path / "large"
    folder.mkdir()
    data = bytes(range(256)) * (24 << 12)  # 24 MiB; parts are 10 MiB at least
    (folder / "steps.parquet").write_bytes(data)
    seal(folder)
    store_copy(folder, "k3v9m2xq")
    with ArchiveStore(URL).reading("k3v9m2xq") as back:
        assert (back / "steps.parquet").read_bytes() == data


def test_an_upload_leaves_those_of_other_processes_alone(archive, bucket):
    """Neither finished files of another run nor an unfinished upload of the same file is touched."""
    put(bucket, "runs/p7/steps.parquet", b"another's")
    other = bucket.open_output_stream("lab/runs/k3v9m2xq/steps.parquet")
    other.write(bytes(11 << 20))  # more than a part: a multipart upload is begun
    store_copy(archive, "k3v9m2xq")
    assert bucket.open_input_stream("lab/runs/p7/steps.parquet").read() == b"another's"
    with ArchiveStore(URL).reading("k3v9m2xq") as folder:
        restore(folder)
    other.close()  # it was not aborted


def seal(folder):
    run = {"run_id": "k3v9m2xq", "name": "n", "created": "2026-01-01", "status": "finished"}
    (folder / layout.MANIFEST).write_bytes(Manifest(run, {}, entries_of(folder)).to_json())


def test_what_is_missing_or_changed_there_is_named(archive, bucket):
    store_copy(archive, "k3v9m2xq")
    store = ArchiveStore(URL)
    key = f"runs/k3v9m2xq/{layout.EPISODES}"
    data = bytearray((archive / layout.EPISODES).read_bytes())
    data[7] ^= 1
    put(bucket, key, bytes(data))
    with store.reading("k3v9m2xq") as folder, pytest.raises(RecordingError, match=r"episodes\.parquet"):
        restore(folder)
    put(bucket, key, bytes(data[:-1]))
    with pytest.raises(RecordingError, match=r"episodes\.parquet: found .* bytes"), store.reading("k3v9m2xq"):
        pass
    bucket.delete_file(f"lab/{key}")
    with pytest.raises(RecordingError, match=r"episodes\.parquet: is missing"), store.reading("k3v9m2xq"):
        pass
    with pytest.raises(RecordingError, match="found no archive there"), store.reading("p7"):
        pass


def test_a_storage_that_cannot_be_reached_or_refuses_is_reported(archive, bucket, monkeypatch):
    with (
        pytest.raises(StorageError, match="bucket does not exist"),
        ArchiveStore("s3://nowhere/runs").writing("k3v9m2xq") as folder,
    ):
        shutil.copytree(archive, folder, dirs_exist_ok=True)
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    with pytest.raises(StorageError, match="Could not connect"):
        ArchiveStore(URL).manifest("k3v9m2xq")
    with pytest.raises(RunnerError, match="found no bucket"):
        ArchiveStore("s3://")


@pytest.mark.parametrize("location", [URL, "folder"])
def test_no_name_leads_out_of_the_store(bucket, location, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    store = ArchiveStore(location)
    for run_id in ("..", ".", "a/../..", "/etc", ""):
        with pytest.raises(RecordingError, match="is not the name of an archive's file"):
            store.manifest(run_id)
