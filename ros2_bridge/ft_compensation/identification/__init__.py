"""Payload identification from static poses."""
