"""Errors of the disk to which a run is recorded: recording stops, and the road goes on."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import structlog
from attrs import define

log = structlog.get_logger(__name__)


@define
class Disk:
    """State of the disk, which all files of a run share. After its first error nothing is written.

    So the files of a run end at about the same time.
    """

    error: str = ""
    """The first error; empty: there was none."""

    @property
    def works(self) -> bool:
        """Whether files may be written."""
        return not self.error

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Log an error of the operating system in the block, and stop all writing."""
        try:
            yield
        except OSError as error:
            if not self.error:
                self.error = error.strerror or str(error)
                log.critical("the run is no longer recorded", reason=self.error)
