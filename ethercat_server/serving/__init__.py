"""Clients over TCP. May import `acquisition` and below; loads no pysoem."""
