"""Whatever is in a file that is to be unpacked: what is not exactly a packed run leaves nothing behind."""

from __future__ import annotations

import io
import json
import tarfile
import tracemalloc

import pytest
from blake3 import blake3
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from runner.errors import RunnerError
from runner.packing.packing import pack
from runner.packing.unpacking import unpack
from runner.recording.schema import TRAIN_STEP
from tests.runner.altering import altered


@pytest.fixture(scope="module")
def packed(lake, tmp_path_factory):
    return pack(lake, tmp_path_factory.mktemp("packed") / "a.dualtaxi").path


@pytest.fixture(scope="module")
def members(packed):
    """The headers and data of the members, by name."""
    with tarfile.open(packed) as tar:
        return [(member, tar.extractfile(member).read()) for member in tar.getmembers()]


def tar_of(path, members):
    """Write a tar of (header, data)."""
    with path.open("wb") as stream:
        for header, data in members:
            header.size = len(data) if header.isreg() else 0
            padding = bytes(-header.size % 512)
            stream.write(header.tobuf(tarfile.GNU_FORMAT) + data[: header.size] + padding)
        stream.write(bytes(1024))
    return path


def changed(members, which, fields):
    """Return the members with the header of one changed."""
    made = []
    for header, data in members:
        copy = tarfile.TarInfo.frombuf(header.tobuf(), "utf-8", "strict")
        for key, value in fields.items() if header.name == which else ():
            setattr(copy, key, value)
        made.append((copy, data))
    return made


def with_data(members, truthful=True, **files):
    """Return the members with other data in some; the manifest tells the truth of them."""
    data = {header.name: data for header, data in members} | files
    if truthful:
        manifest = json.loads(data["manifest.json"])
        for member in manifest["members"]:
            told = data[member["name"]]
            member["size"], member["blake3"] = len(told), blake3(told).hexdigest()
        data["manifest.json"] = json.dumps(manifest, indent=1).encode() + b"\n"
    return [(tarfile.TarInfo(name), told) for name, told in data.items()]


def refused(path, folder, match=None):
    """Check that a file is refused and that nothing at all is written."""
    recordings = folder / "recordings"
    before = sorted(folder.rglob("*"))
    with pytest.raises(RunnerError, match=match) as caught:
        unpack(path, recordings)
    assert caught.value.exit_code in (1, 2)
    assert sorted(folder.rglob("*")) == before


@pytest.mark.parametrize("name", ["run.json", "recording.mcap", "manifest.json"])
@pytest.mark.parametrize(
    "fields",
    [
        {"name": "../run.json"},
        {"name": "/tmp/run.json"},
        {"name": "x/../recording.mcap"},
        {"name": "recording.mcap\n"},
        {"name": "run.json/"},
        {"name": "C:\\run.json"},
        {"type": tarfile.SYMTYPE, "linkname": "/etc/passwd"},
        {"type": tarfile.LNKTYPE, "linkname": "../run.json"},
        {"type": tarfile.CHRTYPE},
        {"type": tarfile.FIFOTYPE},
        {"type": tarfile.DIRTYPE},
        {"type": tarfile.GNUTYPE_LONGNAME},
        {"type": tarfile.XHDTYPE},
        {"type": tarfile.GNUTYPE_SPARSE},
        {"mode": 0o4755},
        {"mtime": 5},
        {"uname": "root"},
    ],
    ids=str,
)
def test_a_member_of_another_name_or_kind(members, tmp_path, name, fields):
    refused(tar_of(tmp_path / "x.dualtaxi", changed(members, name, fields)), tmp_path)


def test_members_twice_missing_added_or_in_another_order(members, tmp_path):
    manifest, run, recording = members
    extra = tarfile.TarInfo("extra"), b"x"
    for k, made in enumerate(
        (
            [manifest, run, run, recording],
            [manifest, run, recording, recording],
            [manifest, manifest, run, recording],
            [manifest, recording, run],
            [run, manifest, recording],
            [manifest, run],
            [manifest],
            [],
            [manifest, run, recording, extra],
            [extra, manifest, run, recording],
        )
    ):
        refused(tar_of(tmp_path / f"{k}.dualtaxi", made), tmp_path)


def test_what_is_no_pack(packed, tmp_path, lake):
    for name, data in {
        "empty": b"",
        "text": b"hello",
        "zeros": bytes(1 << 20),
        "recording": lake.recording.read_bytes(),
        "more": packed.read_bytes() + b"x",
        "padded": packed.read_bytes() + bytes(512),
    }.items():
        (tmp_path / name).write_bytes(data)
        refused(tmp_path / name, tmp_path)
    refused(tmp_path / "missing", tmp_path)
    refused(tmp_path, tmp_path, "found a folder, expected the file that `dualtaxi pack` writes")


def test_cut_anywhere(packed, tmp_path):
    data = packed.read_bytes()
    for end in {*range(0, len(data), 1999), *range(len(data) - 1030, len(data), 37), 511, 512, 513}:
        (tmp_path / "x").write_bytes(data[:end])
        refused(tmp_path / "x", tmp_path)


@given(place=st.floats(0, 1, exclude_max=True), flip=st.integers(1, 255))
@settings(max_examples=120, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_changed_byte(packed, tmp_path, place, flip):
    data = bytearray(packed.read_bytes())
    data[int(place * len(data))] ^= flip
    (tmp_path / "x").write_bytes(data)
    refused(tmp_path / "x", tmp_path)


def test_a_declared_size_is_not_believed(members, tmp_path):
    """Neither is so much read into memory, nor so much written."""
    for name, size in {"manifest.json": 1 << 40, "run.json": 1 << 33, "recording.mcap": 1 << 50}.items():
        made = [
            (tarfile.TarInfo.frombuf(header.tobuf(), "ascii", "strict"), data) for header, data in members
        ]
        stream = io.BytesIO()
        for header, data in made:
            header.size = size if header.name == name else len(data)
            stream.write(header.tobuf(tarfile.GNU_FORMAT) + data + bytes(-len(data) % 512))
        (tmp_path / "x").write_bytes(stream.getvalue())
        tracemalloc.start()
        refused(tmp_path / "x", tmp_path)
        assert tracemalloc.get_traced_memory()[1] < 20 << 20
        tracemalloc.stop()


def test_a_huge_recording_of_nothing(members, tmp_path):
    """A file that declares and holds a terabyte of zeros on a few kilobytes of disk."""
    data = {header.name: data for header, data in members}
    manifest = json.loads(data["manifest.json"])
    manifest["members"][1]["size"] = 1 << 43
    said = json.dumps(manifest, indent=1).encode() + b"\n"
    head = tar_of(tmp_path / "x", [(tarfile.TarInfo("manifest.json"), said), members[1]]).read_bytes()[:-1024]
    huge = tarfile.TarInfo("recording.mcap")
    huge.size = 1 << 43
    with (tmp_path / "x").open("wb") as stream:
        stream.write(head + huge.tobuf(tarfile.GNU_FORMAT))
        stream.truncate(len(head) + 512 + (1 << 43) + 1024)
    refused(tmp_path / "x", tmp_path, "room")


@pytest.mark.parametrize(
    "change",
    [
        {"run_id": "../../x"},
        {"run_id": ".."},
        {"run_id": "a/b"},
        {"run_id": "aaaaaaaa"},
        {"run_id": ""},
        {"name": "../x"},
        {"seed": -1},
        {"seed": True},
        {"status": "running"},
        {"status": "interrupted"},
        {"content_digest": "0" * 64},
        {"content_digest": "0" * 63 + "\n"},
        {"dualtaxi_pack": 1},
        {"dualtaxi_pack": "0"},
        {"members": []},
        {"more": 1},
    ],
    ids=str,
)
def test_a_manifest_that_says_something_else(members, tmp_path, change):
    data = {header.name: data for header, data in members}
    said = json.dumps(json.loads(data["manifest.json"]) | change, indent=1).encode() + b"\n"
    made = with_data(members, truthful=False, **{"manifest.json": said})
    refused(tar_of(tmp_path / "x", made), tmp_path)


def test_a_manifest_that_is_no_json(members, tmp_path):
    for said in (b"", b"[]", b"[" * 60_000, b"null", b"\xff", b'{"dualtaxi_pack": 0}'):
        made = with_data(members, truthful=False, **{"manifest.json": said})
        refused(tar_of(tmp_path / "x", made), tmp_path)


@pytest.mark.parametrize(
    "change",
    [
        {"run_id": "aaaaaaaa"},
        {"recording": "/etc/passwd"},
        {"owner": {"host": "x"}},
        {"status": "running"},
        {"created": "yesterday"},
        {"config": {}},
        {"summary": {}},
        {"summary": None},
        {"seed": 7},
        {"name": "\x1b[31m"},
        {"proof": "x"},
    ],
    ids=str,
)
def test_facts_that_are_not_the_recordings(members, tmp_path, change):
    data = {header.name: data for header, data in members}
    said = json.dumps(json.loads(data["run.json"]) | change, indent=1, ensure_ascii=False).encode() + b"\n"
    refused(tar_of(tmp_path / "x", with_data(members, **{"run.json": said})), tmp_path)


def test_labels_that_are_none(members, tmp_path):
    manifest = json.loads(members[0][1])
    manifest["members"].insert(1, {"name": "labels.json", "size": 1, "blake3": "0" * 64})
    for labels in (b"[1]", b"", b"no"):
        rest = {"labels.json": labels, "recording.mcap": members[2][1]}
        told = {"manifest.json": json.dumps(manifest).encode(), "run.json": members[1][1], **rest}
        refused(
            tar_of(tmp_path / "x", with_data([(tarfile.TarInfo(n), d) for n, d in told.items()])), tmp_path
        )


def test_a_recording_that_was_altered_by_who_knows_the_format(lake, members, tmp_path):
    """Every checksum fits, but the digest that it states is not that of its messages."""

    def change(steps):
        steps["rewards"][3] += 1
        return steps

    other = altered(lake.recording, tmp_path / "other.mcap", TRAIN_STEP, change)
    made = with_data(members, **{"recording.mcap": other.read_bytes()})
    refused(tar_of(tmp_path / "x", made), tmp_path)


def test_a_created_time_that_is_none(lake, members, tmp_path):
    other = altered(
        lake.recording, tmp_path / "other.mcap", None, None, run=lambda run: run | {"created": "yesterday"}
    )
    facts = json.loads(members[1][1]) | {"created": "yesterday"}
    facts["summary"]["bytes"] = other.stat().st_size
    said = json.dumps(facts, indent=1, ensure_ascii=False).encode() + b"\n"
    made = with_data(members, **{"recording.mcap": other.read_bytes(), "run.json": said})
    refused(tar_of(tmp_path / "x", made), tmp_path, "created: found")


def test_nothing_else_in_the_folder_is_touched(packed, tmp_path, lake):
    recordings = tmp_path / "recordings"
    recordings.mkdir()
    (recordings / lake.run_id).write_text("mine")
    refused(packed, tmp_path, "no run")
    assert (recordings / lake.run_id).read_text() == "mine"
