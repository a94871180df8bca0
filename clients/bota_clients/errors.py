"""The exceptions of the programs here. Each text is one sentence, which a program prints before it exits 1.

ClientError
+-- ReportError              no report can be made
+-- RecordingError           a recording cannot be read or written
    +-- NotARecordingError   the file is something else, or of an unknown version
    +-- DamagedError         the file is a recording, but a part of it is corrupt
    +-- DiskError            the file cannot be written
"""

from __future__ import annotations


class ClientError(Exception):
    """Base of all errors here."""


class ReportError(ClientError):
    """No report can be made."""


class RecordingError(ClientError):
    """A recording cannot be read or written."""


class NotARecordingError(RecordingError):
    """The file is not a recording that this program can read."""


class DamagedError(RecordingError):
    """A part of the recording is corrupt."""


class DiskError(RecordingError):
    """The file cannot be written: disk full, permission denied, or an I/O error."""
