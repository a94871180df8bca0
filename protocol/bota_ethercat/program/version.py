# SPDX-License-Identifier: Apache-2.0
"""The version, as in pyproject.toml: asking the installed package takes as long as starting Python."""

VERSION = "0.1.0"
