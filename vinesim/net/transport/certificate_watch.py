"""Watches a folder of certificates: detects changed files, and warns of certificates that are about to expire."""

from __future__ import annotations

import logging
import pathlib
import time

from vinesim.net.transport import certificates
from vinesim.net.transport.bus import BusError

log = logging.getLogger(__name__)

WATCH_PERIOD = 1.0
"""Time between two checks of a folder [s]."""

WARNING_PERIOD = 86400.0
"""Time between two warnings of one certificate that is about to expire [s]."""


class CertificateWatch:
    """Watches a folder of certificates. Call its methods once a :data:`WATCH_PERIOD`, from a thread that may read
    files."""

    def __init__(self, folder: pathlib.Path) -> None:
        self._folder = folder
        self._loaded = self._seen = self._state()
        self._next_warning = 0.0

    def has_changed(self) -> bool:
        """Whether files were added, replaced or removed, and not changed again until this call. True once for each
        change.

        A certificate and its key are two files, so just after one was written the other may still be missing.
        """
        seen = self._seen
        self._seen = self._state()
        if self._seen != seen or self._seen == self._loaded:
            return False
        self._loaded = self._seen
        self._next_warning = 0.0
        return True

    def warn(self) -> None:
        """Log which certificates are about to expire, at the first call, after a change, and once a day."""
        if time.monotonic() < self._next_warning:
            return
        self._next_warning = time.monotonic() + WARNING_PERIOD
        try:
            for line in certificates.expiring(self._folder):
                log.warning("%s", line)
        except BusError as error:
            log.warning("%s", error)

    def _state(self) -> tuple[tuple[str, int, int, int], ...]:
        """Returns name, time of change, size and inode of each file, to detect changes."""
        found = []
        for file in sorted([*self._folder.glob("*.pem"), *self._folder.glob("*.key")]):
            try:
                status = file.stat()
            except OSError:  # the file was removed meanwhile
                continue
            found.append((file.name, status.st_mtime_ns, status.st_size, status.st_ino))
        return tuple(found)
