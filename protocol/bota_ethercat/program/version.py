# SPDX-License-Identifier: Apache-2.0
"""The installed version."""

from importlib.metadata import PackageNotFoundError, version

VERSION = "0+unknown"  # run from a checkout that was never installed
for _distribution in ("bota-ethercat", "bota-ethercat-bridge"):  # a checkout is installed as the latter only
    try:
        VERSION = version(_distribution)
        break
    except PackageNotFoundError:
        pass
