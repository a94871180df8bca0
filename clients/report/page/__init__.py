"""The HTML page of the report and its plots."""
