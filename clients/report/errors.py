"""The exception of the report: its text is one sentence for a person."""

from __future__ import annotations


class ReportError(Exception):
    """No report can be made."""
