"""The distributed clock (DC) unit of a slave controller, and what may be wrong with it."""
