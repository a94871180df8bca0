"""Tests of the programs in `clients`."""
