"""What becomes of the figures: tables, the plot, the page docs/benchmark.md."""
