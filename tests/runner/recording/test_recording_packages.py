"""The versions of installed packages in the provenance of a recording."""

import base64

import pytest
import zstandard

from runner.errors import RecordingError
from runner.recording.metadata import packed_provenance, unpacked_provenance

PROVENANCE = {"host": "h", "package.numpy": "2.0", "package.ray": "1"}


def test_they_come_back_from_one_entry() -> None:
    packed = packed_provenance(PROVENANCE)
    assert packed.keys() == {"host", "packages"}
    assert unpacked_provenance(packed, "here") == PROVENANCE


def test_those_of_earlier_recordings_are_read() -> None:
    assert unpacked_provenance(PROVENANCE, "here") == PROVENANCE


@pytest.mark.parametrize("content", [b"[1]", b'{"numpy": 1}', b'{"numpy": "' + b"1" * (2 << 20) + b'"}'])
def test_damaged_ones_are_refused(content: bytes) -> None:
    packages = base64.b64encode(zstandard.compress(content)).decode()
    with pytest.raises(RecordingError, match="here: the packages of its provenance"):
        unpacked_provenance({"packages": packages}, "here")


@pytest.mark.parametrize("packages", ["no Base64!", base64.b64encode(b"no zstd").decode()])
def test_unreadable_ones_are_refused(packages: str) -> None:
    with pytest.raises(RecordingError, match="are damaged"):
        unpacked_provenance({"packages": packages}, "here")
