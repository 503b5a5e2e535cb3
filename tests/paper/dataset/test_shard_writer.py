"""Workers write the shards of a dataset themselves, and races between them do no harm."""

from __future__ import annotations

from pathlib import Path

import pytest

from spackle.paper.dataset import DatasetFiles, shard_writer
from spackle.paper.dataset.shard_writer import ShardWriter


@pytest.fixture
def writer(whole: Path, tmp_path: Path) -> ShardWriter:
    """A writer of three photos in shards of two; two of the photos wait for their shard."""
    writer = ShardWriter(tmp_path, shard_size=2, photo_count=3)
    writer.parts.mkdir()
    files = DatasetFiles(whole)
    shard, sample = files.samples[0]
    data = (whole / shard.file).read_bytes()[sample.offset : sample.offset + sample.size]
    writer.write_sample(0, data)
    writer.write_problem(1, "b.png: damaged")
    return writer


def test_the_last_photo_of_a_shard_writes_it(writer: ShardWriter) -> None:
    assert writer.write_shard_if_ready(1) is None
    assert not writer.is_done(2)
    entry = writer.write_shard_if_ready(0)
    assert entry is not None
    assert ([sample.key for sample in entry.samples], entry.passed_over) == (
        ["000000"],
        ("b.png: damaged",),
    )
    assert [path.name for path in writer.parts.iterdir()] == ["shard-000000.json"]
    assert writer.is_done(0)
    assert writer.is_done(1)
    assert writer.write_shard_if_ready(0) == entry
    # A shard that is gone is made again.
    (writer.output / entry.file).unlink()
    assert not writer.is_done(0)


def test_two_processes_may_write_a_shard_at_once(
    writer: ShardWriter, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_shard = shard_writer.write_shard
    entries = []

    def overtaken(*arguments: object) -> object:
        """Write the shard after another process has written it and deleted its parts."""
        monkeypatch.setattr(shard_writer, "write_shard", write_shard)
        entries.append(writer.write_shard_if_ready(0))
        return write_shard(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(shard_writer, "write_shard", overtaken)
    assert writer.write_shard_if_ready(0) == entries[0] is not None
    assert list(writer.output.glob(".*")) == []


def test_a_resumed_build_tries_failed_photos_again(writer: ShardWriter) -> None:
    assert writer.is_done(1)
    writer.remove_problems()
    assert not writer.is_done(1)
    assert writer.write_shard_if_ready(0) is None
    assert writer.is_done(0)
