"""The benchmark's plot: for each configuration, which part of the samples was older than a given age."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np

from scripts.benchmarks.statistics import Floats

_LONGEST_US: Final = 30_000
_LOOKS: Final = {
    "bare C": ("bare C program, C client", "0.45", "-"),
    "this": ("this project, TCP client", "tab:blue", "-"),
    "this, ROS": ("this project, ROS subscriber", "tab:blue", "--"),
    "Bota's driver": ("Bota's driver, its caller", "tab:red", "-"),
    "polling": ("polling, TCP client", "tab:orange", "-"),
}


def draw(configurations: Mapping[tuple[int, int], Mapping[str, Floats]], path: Path) -> None:
    """Write the plot as PNG: ages in ns, by program, for each rate and number of sensors."""
    import matplotlib as mpl  # noqa: PLC0415 - slow, and an extra

    mpl.use("Agg")
    from matplotlib import pyplot  # noqa: PLC0415

    # With several sensors two of the curves are left, much the same.
    configurations = {key: ages for key, ages in configurations.items() if key[1] == 1} or configurations
    figure, axes = pyplot.subplots(
        1, len(configurations), figsize=(6.8 * len(configurations), 5.3), squeeze=False, sharey=True
    )
    shown = {}
    for panel, ((rate, sensors), ages) in zip(axes.flat, configurations.items(), strict=True):
        for name, (label, color, style) in _LOOKS.items():
            if count := len(ages.get(name, ())):
                older = 1 - np.arange(count) / count
                (line,) = panel.plot(np.sort(ages[name]) / 1000, older, style, color=color, linewidth=1.6)
                shown[label] = line
        panel.axvline(1e6 / rate, color="0.7", linestyle=":", linewidth=1)
        panel.annotate(
            "one sample period", (1e6 / rate, 7e-5), rotation=90, fontsize=7, color="0.5", ha="right"
        )
        panel.grid(True, which="both", alpha=0.2)
        panel.set(
            title=f"{rate} Hz, {sensors} sensor{'s' * (sensors > 1)}",
            xscale="log", yscale="log", xlim=(10, _LONGEST_US), ylim=(5e-5, 1.3),
            xlabel="age of the sample on arrival, µs", ylabel="part of the samples that is older",
        )  # fmt: skip
    columns = 1 + len(configurations)
    figure.legend(shown.values(), shown.keys(), loc="lower center", ncols=columns, frameon=False)
    figure.tight_layout(rect=(0, 0.15, 1, 1))
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90, facecolor="white")  # a page in dark colors shows it as well
    pyplot.close(figure)
