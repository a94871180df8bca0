# SPDX-License-Identifier: Apache-2.0
"""JSON and text from the peer: bounded, checked, safe to print. Imports `bota_ethercat.errors` only."""
