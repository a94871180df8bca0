"""`ethercat-export`: a recording as CSV, as all samples, or as windows before each camera frame."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterator


def batches(
    path: str | Path, sensor: int | None = None, *, tool: str | Path | None = None, imu_units: str = "g_dps"
) -> Iterator[Any]:
    """The samples of a sensor as tables of `pyarrow`, some 100,000 rows each (docs/datasets.md).

    With `tool`, a file of `ethercat-identify --yaml`, also the compensated wrench. RecordingError.
    """
    from argparse import Namespace  # noqa: PLC0415

    from bota_clients.export.collection import tables_of  # noqa: PLC0415 - needs the extra `dataset`
    from bota_clients.recording.reader import open_recording  # noqa: PLC0415
    from bota_ethercat.pdo import ImuUnits  # noqa: PLC0415

    options = Namespace(imu_units=ImuUnits(imu_units), tool=None if tool is None else Path(tool))
    with open_recording(Path(path)) as recording:
        yield from tables_of(options, recording, sensor)


def table(path: str | Path, sensor: int | None = None, **options: Any) -> Any:
    """As `batches`, in one table."""
    import pyarrow as pa  # noqa: PLC0415 - of the extra `dataset`

    return pa.concat_tables(batches(path, sensor, **options))
