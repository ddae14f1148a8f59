"""Readers of rare formats, which register themselves."""
