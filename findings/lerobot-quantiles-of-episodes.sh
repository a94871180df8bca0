#!/usr/bin/env bash
# LeRobot 0.6.1: a data set's quantiles are the mean of its episodes' quantiles: of rare contact, a tenth of the force.
#
# One would guess: `q99` in the statistics is the value that 1 % of the rows exceed, as numpy.quantile has it.
# What happens: each episode's quantiles are averaged, weighted by rows. With 20 N of contact in one of ten episodes q99
# is 2.2 N instead of 20.1 N, and the median 2.0 N, which no row has, instead of 0. Mean and standard deviation are
# pooled rightly. A user meets it with policies that normalize by quantiles: 20 N is 15 where it should be 1, and pi05,
# which counts the state in 256 steps from -1 to 1, has one step, 255, for all above 2.2 N: 3 N and 20 N read the same
# (its own code, run with torch, gives the same). One call of `get_feature_stats` with all rows has it right. Here only
# NumPy is installed beside LeRobot. Reported as huggingface/lerobot #4156.
set -euo pipefail
for python in python3.12 python3.13 python3.14 python3 none; do
  if "$python" -c 'import sys; sys.exit(sys.version_info < (3, 12))' 2>/dev/null; then break; fi
done
[ "$python" != none ] || { echo "LeRobot 0.6.1 needs Python 3.12 or newer on PATH." >&2; exit 77; }
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"$python" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check --no-deps lerobot==0.6.1 'numpy<3'
cat >"$folder/check.py" <<'END'
import sys
from importlib.metadata import version
from types import ModuleType
from unittest.mock import MagicMock

import lerobot
import numpy as np

sys.modules["lerobot.datasets"] = package = ModuleType("lerobot.datasets")  # its own imports torch
package.__path__ = [f"{lerobot.__path__[0]}/datasets"]
for name in ("lerobot.processor", "lerobot.utils.constants", "lerobot.datasets.io_utils"):
    sys.modules[name] = MagicMock()
from lerobot.datasets.compute_stats import aggregate_stats, get_feature_stats

random = np.random.default_rng(1)
episodes = [random.normal(0, 0.1, (900, 1)).astype(np.float32) for _ in range(10)]
episodes[3][100:] += 20  # N
rows = np.concatenate(episodes)
stats = aggregate_stats([{"force": get_feature_stats(each, axis=0, keepdims=False)} for each in episodes])["force"]
at_once = get_feature_stats(rows, axis=0, keepdims=False)

print(f"LeRobot {version('lerobot')}: 20 N of contact in one of ten episodes")
for name, part in {"q01": 0.01, "q50": 0.5, "q90": 0.9, "q99": 0.99}.items():
    print(f"{name}: {stats[name][0]:.2f} N of the episodes, {at_once[name][0]:.2f} N of all rows at once,",
          f"numpy.quantile {np.quantile(rows, part):.2f} N")
print(f"std: {stats['std'][0]:.2f} N of the episodes, numpy.std {rows.std(dtype=float):.2f} N")
low, high = stats["q01"][0], stats["q99"][0]
steps = {}
for force in (0.0, 1.0, 3.0, 20.0):
    normalized = 2 * (force - low) / (high - low) - 1
    steps[force] = int(np.digitize(normalized, np.linspace(-1, 1, 257)[:-1])) - 1
    print(f"{force:g} N is normalized to {normalized:.2f}: step {steps[force]} of 0 to 255")
assert abs(at_once["q99"][0] - np.quantile(rows, 0.99)) < 0.1 and np.quantile(rows, 0.99) > 20
assert abs(stats["std"][0] / rows.std(dtype=float) - 1) < 0.01
assert not ((0.6 < rows) & (rows < 19)).any() and steps[3.0] == steps[20.0] == 255, "the behavior has changed"
assert 2 < high < 2.5 and 1.9 < stats["q50"][0] < 2.1, "the behavior has changed"
END
"$folder/venv/bin/python" "$folder/check.py"
