"""Tests of the server, from its parts to the whole process."""
