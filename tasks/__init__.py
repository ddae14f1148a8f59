"""Downstream tasks: angle of arrival and RSSI."""
