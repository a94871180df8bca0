# SPDX-License-Identifier: Apache-2.0
"""Deprecated name of `bota_ethercat_bridge`."""

from bota_ethercat.renamed import forward

forward(__name__, "bota_ethercat_bridge")
