"""Parquet files can be read after every batch, also if their process is killed."""

from __future__ import annotations

import errno
import io
import signal
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from laneweave.protocol.files import overwrite
from laneweave.sim_bridge.recording.growing_parquet import GrowingParquet

COLUMNS: list[pa.Field[Any]] = [
    pa.field("t_s", pa.float64(), nullable=False),
    pa.field("name", pa.string()),
]
SCHEMA = pa.schema(COLUMNS, {"key": "value"})
WRITE_AND_DIE = """
import os, signal, sys
from pathlib import Path
import pyarrow as pa
from laneweave.protocol.files import overwrite
from laneweave.sim_bridge.recording.growing_parquet import GrowingParquet

schema = pa.schema([pa.field("number", pa.int64())])
file = GrowingParquet(Path(sys.argv[1]), schema)
for first in (0, 10, 20):
    rows = [{"number": number} for number in range(first, first + 10)]
    file.append(pa.RecordBatch.from_pylist(rows, schema))
os.kill(os.getpid(), signal.SIGKILL)
"""


def rows(first: int, count: int) -> list[dict[str, Any]]:
    return [
        {"t_s": 0.5 * n, "name": f"v{n}" if n % 7 else None} for n in range(first, first + count)
    ]


def batch(first: int, count: int) -> pa.RecordBatch:
    return pa.RecordBatch.from_pylist(rows(first, count), SCHEMA)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"use_dictionary": False, "compression": "none"},
        {"use_dictionary": ["name"], "use_byte_stream_split": ["t_s"]},
    ],
    ids=["default", "plain", "split"],
)
def test_the_file_is_complete_after_each_batch(tmp_path: Path, options: dict[str, Any]) -> None:
    path = tmp_path / "file.parquet"
    with closing(GrowingParquet(path, SCHEMA, **options)) as file:
        assert pq.read_table(path).num_rows == 0
        first = 0
        for count in (1, 1000, 0, 17, 5000):
            file.append(batch(first, count))
            first += count
            table = pq.read_table(path)
            assert table.to_pylist() == rows(0, first)
            assert table.schema.equals(SCHEMA, check_metadata=True)
    assert pq.ParquetFile(path).num_row_groups == 4  # none for the batch without rows


def test_other_files_with_the_same_rows_are_hardly_smaller(tmp_path: Path) -> None:
    with closing(GrowingParquet(tmp_path / "grown.parquet", SCHEMA)) as file:
        for first in range(0, 20_000, 2000):
            file.append(batch(first, 2000))
    pq.write_table(
        pa.Table.from_batches([batch(0, 20_000)]),
        tmp_path / "whole.parquet",
        compression="zstd",
        row_group_size=2000,
    )
    sizes = [(tmp_path / name).stat().st_size for name in ("grown.parquet", "whole.parquet")]
    assert sizes[0] <= 1.01 * sizes[1]


@pytest.mark.slow
def test_a_killed_process_loses_only_what_it_has_not_written(tmp_path: Path) -> None:
    path = tmp_path / "file.parquet"
    ended = subprocess.run([sys.executable, "-c", WRITE_AND_DIE, path], timeout=60, check=False)
    assert ended.returncode == -signal.SIGKILL
    assert pq.read_table(path)["number"].to_pylist() == list(range(30))


def test_the_next_batch_replaces_a_provisional_one(tmp_path: Path) -> None:
    path = tmp_path / "file.parquet"
    with closing(GrowingParquet(path, SCHEMA)) as file:
        file.append(batch(0, 10))
        for count in (3000, 5000, 20):
            file.append(batch(10, count), provisional=True)
            assert pq.read_table(path).to_pylist() == rows(0, 10 + count)
        assert path.stat().st_size < 5000  # nothing is left of the longer ones
        file.append(batch(10, 0))
        file.append(batch(10, 30))
        file.append(batch(40, 5), provisional=True)
    assert pq.read_table(path).to_pylist() == rows(0, 45)
    assert pq.ParquetFile(path).num_row_groups == 3


WRITE_TOO_MUCH = """
import resource, sys
from pathlib import Path
import pyarrow as pa
from laneweave.sim_bridge.recording.disk import Disk
from laneweave.protocol.files import overwrite
from laneweave.sim_bridge.recording.growing_parquet import GrowingParquet

schema = pa.schema([pa.field("number", pa.int64())])
disk = Disk()
file = GrowingParquet(Path(sys.argv[1]), schema, disk, compression="none", use_dictionary=False)
numbers = iter(range(1000))
for size in (10, 10, 100_000, 10):
    if size > 10:
        limit = Path(sys.argv[1]).stat().st_size + 1000
        # The copy of a row group is larger than the file, so it reaches the limit, too.
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    rows = [{"number": number} for number in range(size)]
    file.append(pa.RecordBatch.from_pylist(rows, schema))
    print(disk.works)
file.close()
"""


@pytest.mark.slow
def test_what_was_written_before_the_disk_was_full_can_be_read(tmp_path: Path) -> None:
    path = tmp_path / "file.parquet"
    command = [sys.executable, "-c", WRITE_TOO_MUCH, str(path)]
    ended = subprocess.run(command, timeout=60, check=True, capture_output=True, text=True)
    assert [line for line in ended.stdout.split() if line in ("True", "False")] == [
        *("True", "True", "False", "False")
    ]
    assert ended.stdout.count("no longer recorded") + ended.stderr.count("no longer recorded") == 1
    assert pq.read_table(path)["number"].to_pylist() == [*range(10), *range(10)]


class _ShortFile(io.FileIO):
    """A file that cannot become longer than 12 bytes, as on a full disk."""

    def write(self, data: Any) -> int:  # noqa: ANN401 (as its base class)
        return super().write(bytes(data)[: max(12 - self.tell(), 0)])


@pytest.mark.parametrize("begin", [0, 4, 8])
def test_a_write_without_room_leaves_a_file_as_it_was(tmp_path: Path, begin: int) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"12345678")
    with closing(_ShortFile(path, "rb+")) as file:
        with pytest.raises(OSError, match="No space left") as failed:
            overwrite(file, begin, b"x" * 100)
        assert failed.value.errno == errno.ENOSPC
        assert path.read_bytes() == b"12345678"
        overwrite(file, begin, b"abc")
    assert path.read_bytes() == b"12345678"[:begin] + b"abc"
