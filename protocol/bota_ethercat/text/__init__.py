"""JSON and text from the peer: bounded, checked, safe to print. Imports `bota_ethercat.errors` only."""
