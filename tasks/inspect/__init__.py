"""Inspect measurements before a model is fitted."""
