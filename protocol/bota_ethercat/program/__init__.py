# SPDX-License-Identifier: Apache-2.0
"""What every program does alike: which server it uses, how it starts, how it writes files."""
