# SPDX-License-Identifier: Apache-2.0
"""Deprecated name of `bota_ft_compensation`."""

from bota_ethercat.renamed import forward

forward(__name__, "bota_ft_compensation")
