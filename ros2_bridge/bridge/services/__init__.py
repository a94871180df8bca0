"""The services of the node; `triggers` makes them, `window` takes the samples that some need."""
