# SPDX-License-Identifier: Apache-2.0
"""Import packages under their old names, for one release: every module is the one of the new name."""

import importlib.util
import sys
import warnings
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from typing import Any


class _Forwarder(MetaPathFinder, Loader):
    def __init__(self, old: str, new: str) -> None:
        self._old, self._new = f"{old}.", f"{new}."

    def find_spec(self, name: str, *_: object) -> Any:
        is_ours = name.startswith(self._old)
        real = importlib.util.find_spec(self._new + name.removeprefix(self._old)) if is_ours else None
        return real and ModuleSpec(name, self, loader_state=real)

    def get_code(self, name: str) -> Any:  # for `python -m`
        return self.find_spec(name).loader_state.loader.get_code(None)

    def create_module(self, spec: ModuleSpec) -> Any:
        return importlib.import_module(spec.loader_state.name)

    def exec_module(self, module: Any) -> None:
        module.__spec__ = module.__spec__.loader_state  # importlib has set that of the old name


def forward(old: str, new: str) -> None:
    """To be called while the package `old` is imported."""
    text = f"the package {old} is now {new}, and goes with version 0.2.0: import {new}"
    warnings.warn(text, DeprecationWarning, stacklevel=3)
    sys.meta_path.insert(0, _Forwarder(old, new))
    sys.modules[old] = importlib.import_module(new)
