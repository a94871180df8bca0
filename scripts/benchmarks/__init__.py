"""`scripts/benchmark`: what is compared, how it is recorded, and the table and plot of it."""
