# SPDX-License-Identifier: Apache-2.0
"""The installed version."""

from importlib.metadata import PackageNotFoundError, version

try:
    VERSION = version("bota-ethercat-bridge")
except PackageNotFoundError:  # run from a checkout that was never installed
    VERSION = "0+unknown"
