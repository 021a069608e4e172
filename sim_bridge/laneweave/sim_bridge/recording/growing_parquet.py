"""Parquet files that are complete after every batch of rows, while they still grow.

A Parquet file ends with a footer that lists its row groups. Each batch is written over the footer,
together with a new one, in a single write. So a file can be read during the run, except while a
batch is written, and a process that is killed loses only the rows that it has not written yet.

Large row groups are small and fast to read. So that rows need not wait for one to fill up, they can
be written as a provisional row group, over which the next batch is written.
"""

from __future__ import annotations

import io
import os
import tempfile
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from laneweave.protocol.files import overwrite
from laneweave.sim_bridge.recording.disk import Disk

_MAGIC = b"PAR1"
"""First and last bytes of a Parquet file. The footer's length precedes the last ones."""
_LENGTH_BYTES = 4
_MAX_OVERHEAD_BYTES = 1 << 20
"""Upper bound on the bytes that a row group and a footer need in addition to twice the data."""


class GrowingParquet:
    """Writer of a Parquet file with one row group per batch."""

    def __init__(
        self,
        path: Path,
        schema: pa.Schema,
        disk: Disk | None = None,
        **options: Any,  # noqa: ANN401 (pyarrow's)
    ) -> None:
        """Create the file without rows.

        Args:
            path: the file.
            schema: its columns and metadata.
            disk: errors of its disk, after which no rows are written.
            options: those of `pyarrow.parquet.ParquetWriter`.

        Raises:
            OSError: the file cannot be created.
        """
        self.schema = schema
        self._disk = disk or Disk()
        self._options = {"compression": "zstd", **options}
        self._file = path.open("wb+", buffering=0)
        overwrite(self._file, 0, _MAGIC)
        self._end = len(_MAGIC)
        """Position behind the last row group, where the footer begins."""
        _, self._metadata = self._row_group(pa.RecordBatch.from_pylist([], schema))
        self._write(b"", self._metadata)

    def append(self, batch: pa.RecordBatch, *, provisional: bool = False) -> None:
        """Write rows as one row group, in place of a provisional one.

        Args:
            batch: the rows.
            provisional: whether the next row group is to be written over this one.
        """
        if not batch.num_rows or not self._disk.works:
            return
        with self._disk.writing():
            rows, added = self._row_group(batch)
            metadata = self._metadata
            if provisional:
                metadata = pq.read_metadata(io.BytesIO(_footer(metadata)))
            metadata.append_row_groups(added)
            self._write(rows, metadata)
            self._end += 0 if provisional else len(rows)

    def close(self) -> None:
        """Close the file. Idempotent."""
        self._file.close()

    def _row_group(self, batch: pa.RecordBatch) -> tuple[bytes, pq.FileMetaData]:
        """Return the bytes of a row group that begins at `_end`, and metadata that list only it."""
        metadata: list[pq.FileMetaData] = []
        # The metadata contain positions in the file, so write to a copy with a hole up to `_end`.
        # The copy has no name, so that a process that is killed leaves nothing behind.
        with tempfile.TemporaryFile() as copy:
            # Reserved, as a mapping cannot report that the disk is full.
            needed_bytes = 2 * batch.nbytes + _MAX_OVERHEAD_BYTES
            os.posix_fallocate(copy.fileno(), self._end, needed_bytes)
            with pa.memory_map(f"/proc/self/fd/{copy.fileno()}", "r+") as sink:
                with pq.ParquetWriter(
                    sink, self.schema, metadata_collector=metadata, **self._options
                ) as writer:
                    sink.seek(self._end)
                    if batch.num_rows:
                        writer.write_batch(batch)
                end = sink.tell()
            copy.seek(self._end)
            written = copy.read(end - self._end)
        tail_bytes = _LENGTH_BYTES + len(_MAGIC)
        footer_bytes = int.from_bytes(written[-tail_bytes : -len(_MAGIC)], "little")
        return written[: -tail_bytes - footer_bytes], metadata[0]

    def _write(self, rows: bytes, metadata: pq.FileMetaData) -> None:
        """Replace what follows the last row group by rows and a footer."""
        overwrite(self._file, self._end, rows + _footer(metadata)[len(_MAGIC) :])


def _footer(metadata: pq.FileMetaData) -> bytes:
    """Return a Parquet file with metadata only."""
    footer = io.BytesIO()
    metadata.write_metadata_file(footer)
    return footer.getvalue()
