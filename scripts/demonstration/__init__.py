"""`scripts/demo`: starts the whole chain, measures it, shows it."""
