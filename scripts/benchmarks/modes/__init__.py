"""A module for each option of `scripts/benchmark` that measures one part by itself."""
