"""Archives in object storage, against a server on this machine that speaks S3."""

from __future__ import annotations

import json
import shutil
from collections import Counter

import boto3
import pytest
from click.testing import CliRunner
from moto.server import ThreadedMotoServer

from runner.archive import layout, s3
from runner.archive.manifest import Manifest, entries_of, read_manifest
from runner.archive.places import target_of
from runner.archive.restoring import check
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
    """Return a client; `lab` is an empty bucket."""
    for name, value in {
        "AWS_ENDPOINT_URL": server,
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_MAX_ATTEMPTS": "1",
    }.items():
        monkeypatch.setenv(name, value)
    client = boto3.client("s3")
    client.create_bucket(Bucket="lab")
    yield client
    for key in keys(client):
        client.delete_object(Bucket="lab", Key=key)
    for upload in client.list_multipart_uploads(Bucket="lab").get("Uploads", []):
        client.abort_multipart_upload(Bucket="lab", Key=upload["Key"], UploadId=upload["UploadId"])
    client.close()


def keys(client):
    return {found["Key"] for found in client.list_objects_v2(Bucket="lab").get("Contents", [])}


class Cut(Exception):
    """The connection is gone."""


class CountingClient:
    """Counts calls; fails at one of them, if told to."""

    def __init__(self, client, fail_at=None):
        self._client, self._fail_at = client, fail_at
        self.calls = Counter()

    def __getattr__(self, name):
        def call(*args, **kwargs):
            self.calls[name] += 1
            if (name, self.calls[name]) == self._fail_at:
                raise Cut
            return getattr(self._client, name)(*args, **kwargs)

        return call


def counted(monkeypatch, client, fail_at=None):
    """Return a target that goes through a counting client."""
    counting = CountingClient(client, fail_at)
    monkeypatch.setattr(boto3, "client", lambda _: counting)
    return target_of(URL), counting


def test_a_run_goes_there_and_comes_back(run, bucket, tmp_path):
    recordings = shutil.copytree(run.folder.parent, tmp_path / "recordings")

    def command(*words):
        result = CliRunner().invoke(cli, [*words, "--recordings", str(recordings)])
        assert result.exit_code == 0, result.output
        return result

    told = json.loads(command("archive", run.run_id, "--to", URL, "--remove", "--json").stdout)
    assert told["place"] == f"{URL}/{run.run_id}"
    assert find_run(run.run_id, recordings).status == "archived"
    manifest = target_of(URL).manifest(run.run_id)
    assert keys(bucket) == {f"runs/{run.run_id}/{name}" for name in (*manifest.files, layout.MANIFEST)}
    command("restore", run.run_id)
    assert find_run(run.run_id, recordings).summary["content_digest"] == told["content_digest"]
    shutil.rmtree(recordings)
    command("restore", f"{URL}/{run.run_id}")
    command("verify", run.run_id)


@pytest.mark.parametrize(
    "fail_at",
    [
        ("upload_part", 3),
        ("complete_multipart_upload", 1),
        ("complete_multipart_upload", 4),
        ("put_object", 1),
    ],
    ids=lambda fail_at: f"{fail_at[0]} {fail_at[1]}",
)
def test_an_upload_cut_off_leaves_no_archive_and_goes_on_where_it_was(archive, bucket, monkeypatch, fail_at):
    target, cut = counted(monkeypatch, bucket, fail_at)
    with pytest.raises(Cut):
        target.commit("k3v9m2xq", archive)
    assert target.manifest("k3v9m2xq") is None
    if fail_at[0] == "upload_part":
        assert keys(bucket) == set()
    target, second = counted(monkeypatch, bucket)
    target.commit("k3v9m2xq", archive)
    files = read_manifest((archive / layout.MANIFEST).read_bytes(), "here").files
    sent_before = cut.calls["upload_part"] - (fail_at[0] == "upload_part")
    assert second.calls["upload_part"] == len(files) - sent_before
    with target.reading("k3v9m2xq") as folder:
        check(folder)


def test_the_parts_of_a_large_file_are_sent_once(bucket, monkeypatch, tmp_path):
    monkeypatch.setattr(s3, "PART_BYTES", 5 << 20)
    folder = tmp_path / "large"
    folder.mkdir()
    data = bytes(range(256)) * (12 << 12)  # 12 MiB: three parts
    (folder / "steps.parquet").write_bytes(data)
    seal(folder)
    target, _ = counted(monkeypatch, bucket, ("upload_part", 3))
    with pytest.raises(Cut):
        target.commit("k3v9m2xq", folder)
    target, second = counted(monkeypatch, bucket)
    target.commit("k3v9m2xq", folder)
    assert second.calls["upload_part"] == 1
    with target.reading("k3v9m2xq") as back:
        assert (back / "steps.parquet").read_bytes() == data


def test_parts_of_another_content_are_not_taken_for_this_one(bucket, monkeypatch, tmp_path):
    folder = tmp_path / "changing"
    folder.mkdir()
    (folder / "steps.parquet").write_bytes(b"then")
    seal(folder)
    target, _ = counted(monkeypatch, bucket, ("complete_multipart_upload", 1))
    with pytest.raises(Cut):
        target.commit("k3v9m2xq", folder)
    (folder / "steps.parquet").write_bytes(b"now!")
    seal(folder)
    target, _ = counted(monkeypatch, bucket)
    target.commit("k3v9m2xq", folder)
    with target.reading("k3v9m2xq") as back:
        assert (back / "steps.parquet").read_bytes() == b"now!"


def seal(folder):
    run = {"run_id": "k3v9m2xq", "name": "n", "created": "2026-01-01", "status": "finished"}
    (folder / layout.MANIFEST).write_bytes(Manifest(run, {}, entries_of(folder)).to_json())


def test_what_is_missing_or_changed_there_is_named(archive, bucket):
    target = target_of(URL)
    target.commit("k3v9m2xq", archive)
    key = f"runs/k3v9m2xq/{layout.EPISODES}"
    data = bytearray((archive / layout.EPISODES).read_bytes())
    data[7] ^= 1
    bucket.put_object(Bucket="lab", Key=key, Body=bytes(data))
    with target.reading("k3v9m2xq") as folder, pytest.raises(RecordingError, match=r"episodes\.parquet"):
        check(folder)
    bucket.delete_object(Bucket="lab", Key=key)
    with pytest.raises(RecordingError, match=r"episodes\.parquet: is missing"), target.reading("k3v9m2xq"):
        pass
    with pytest.raises(RecordingError, match="found no archive there"), target.reading("p7"):
        pass


def test_a_storage_that_cannot_be_reached_or_refuses_is_told(archive, bucket, monkeypatch):
    with pytest.raises(StorageError, match="NoSuchBucket"):
        target_of("s3://nowhere/runs").commit("k3v9m2xq", archive)
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    with pytest.raises(StorageError, match="Could not connect"):
        target_of(URL).manifest("k3v9m2xq")
    with pytest.raises(RunnerError, match="found no bucket"):
        target_of("s3://")
