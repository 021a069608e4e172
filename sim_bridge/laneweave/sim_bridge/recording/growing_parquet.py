"""Parquet files that are complete after every batch of rows, while they still grow.

A Parquet file ends with a footer that lists its row groups. Each batch is written over the footer,
together with a new one, in a single write. So a file can be read during the run, and a process that
is killed loses only the rows that it has not written yet.
"""

from __future__ import annotations

import io
import tempfile
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

_MAGIC = b"PAR1"
"""First and last bytes of a Parquet file. The footer's length precedes the last ones."""
_LENGTH_BYTES = 4
_MAX_OVERHEAD_BYTES = 1 << 20
"""Upper bound on the bytes that a row group and a footer need in addition to twice the data."""


class GrowingParquet:
    """Writer of a Parquet file with one row group per batch."""

    def __init__(self, path: Path, schema: pa.Schema, **options: Any) -> None:  # noqa: ANN401 (pyarrow's)
        """Create the file without rows; `options` are those of `pyarrow.parquet.ParquetWriter`."""
        self.schema = schema
        self._options = {"compression": "zstd", **options}
        self._file = path.open("wb")
        self._file.write(_MAGIC)
        self._end = len(_MAGIC)
        """Position behind the last row group, where the footer begins."""
        _, self._metadata = self._row_group(pa.RecordBatch.from_pylist([], schema))
        self._write(b"")

    def append(self, batch: pa.RecordBatch) -> None:
        """Write rows as one row group."""
        if batch.num_rows:
            rows, metadata = self._row_group(batch)
            self._metadata.append_row_groups(metadata)
            self._write(rows)

    def close(self) -> None:
        """Close the file. Idempotent."""
        self._file.close()

    def _row_group(self, batch: pa.RecordBatch) -> tuple[bytes, pq.FileMetaData]:
        """Return the bytes of a row group that begins at `_end`, and metadata that list only it."""
        metadata: list[pq.FileMetaData] = []
        # The metadata contain positions in the file, so write to a copy with a hole up to `_end`.
        # The copy has no name, so that a process that is killed leaves nothing behind.
        with tempfile.TemporaryFile() as copy:
            copy.truncate(self._end + 2 * batch.nbytes + _MAX_OVERHEAD_BYTES)
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

    def _write(self, rows: bytes) -> None:
        """Replace the footer by rows and a new footer."""
        footer = io.BytesIO()
        self._metadata.write_metadata_file(footer)
        self._file.seek(self._end)
        self._file.write(rows + footer.getvalue()[len(_MAGIC) :])
        self._file.flush()
        self._end += len(rows)
