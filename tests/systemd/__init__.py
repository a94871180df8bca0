"""Tests of the service: units, installation, and the server under exactly the rights its unit gives."""
