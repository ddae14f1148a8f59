"""Readers of rare formats, which register themselves, and files of maps."""
