"""Fault injection: one table of commands, a module for each subject."""
