"""JSON and text from the peer: bounded, checked, safe to print. Imports `protocol.errors` only."""
