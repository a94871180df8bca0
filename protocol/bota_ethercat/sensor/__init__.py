# SPDX-License-Identifier: Apache-2.0
"""What the sensor's values mean: warnings, filters, settings, data types. Tables only."""
