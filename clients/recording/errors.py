"""Every exception of reading and writing recordings. Each text is one sentence for a person.

RecordingError
+-- NotARecordingError   the file is something else, or of a version that is not known
+-- DamagedError         the file is a recording, but what it holds cannot be trusted
+-- DiskError            what was recorded cannot be written
"""

from __future__ import annotations


class RecordingError(Exception):
    """Base of all errors here."""


class NotARecordingError(RecordingError):
    """The file is not a recording that this program can read."""


class DamagedError(RecordingError):
    """A part of the recording is not what it must be."""


class DiskError(RecordingError):
    """The file cannot be written: no space left, not allowed, or a fault of the disk."""
