"""The exceptions of the programs here. Each text is one sentence, which is printed before exit code 1."""

from __future__ import annotations


class ClientError(Exception):
    """Base of all errors here."""


class RecordingError(ClientError):
    """A recording cannot be read or written: it is something else, damaged, or the disk is full."""
