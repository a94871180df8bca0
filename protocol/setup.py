# SPDX-License-Identifier: Apache-2.0
"""For colcon, of setup.cfg; for pip, use the pyproject.toml above."""

from setuptools import setup

setup()
