"""The exceptions of the programs here. The text is one sentence, which is printed before exit code 1."""


class RecordingError(Exception):
    """A recording cannot be read or written: it is something else, damaged, or the disk is full."""


class NothingAskedForError(RecordingError):
    """A recording has nothing in the part that is asked for."""
