"""The checks of the report, a subject each."""
