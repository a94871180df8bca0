"""What both exports have in common: the recording, how far it is read, and how it ends."""

from __future__ import annotations

from collections.abc import Callable

from rich.console import Console
from rich.progress import Progress

from bota_clients.export.cli import PROGRAM, Options
from bota_clients.program import interrupt_on_signals, say
from bota_clients.recording.reader import Recording, open_recording
from bota_ethercat.errors import FileError

Advance = Callable[[int], object]  # is told how many DATA frames were read since the last call


def export(options: Options, write: Callable[[Recording, Advance], str]) -> int:
    """Have the output written, and say what `write` says of it; returns the exit code.

    Ctrl-C ends it at any time and leaves no file.
    """
    interrupt_on_signals()
    console = Console(stderr=True)
    progress = Progress(console=console, transient=True, disable=not console.is_terminal)
    try:
        with open_recording(options.recording) as recording, progress:
            if recording.cut_off is not None:
                say(
                    PROGRAM,
                    f"{recording.path} was cut off ({recording.cut_off}): the intact part is exported",
                )
            chosen = [each.frames for each in recording.sensors if options.sensor in {None, each.sensor}]
            task = progress.add_task("", total=sum(chosen))
            written = write(recording, lambda frames: progress.advance(task, frames))
    except KeyboardInterrupt:
        say(PROGRAM, "stopped: nothing was written")
        return 1
    except OSError as error:
        raise FileError(f"{options.output} cannot be written: {error.strerror or error}") from None
    say(PROGRAM, f"{options.output}: {written}")
    return 0
