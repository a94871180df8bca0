"""Tests, a folder for each part: protocol, server, virtual sensor, bridge."""
