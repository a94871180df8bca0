"""Recordings: `ethercat-record` writes them, `reader.py` reads them, docs/recording.md is the format."""
