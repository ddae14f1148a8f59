"""Limits of arguments, importable without torch."""

MAX_SUGGESTIONS = 500  # positions to measure next
