"""Answers of a site survey beside its maps: positions of receivers, and places of further access points."""
