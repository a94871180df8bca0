# SPDX-License-Identifier: Apache-2.0
"""A sensor's stream: what is in force for its samples (`timeline`), and which may be used (`usable`)."""
