"""Tests of the virtual sensor, from single registers to pysoem over a veth pair."""
