"""RSSI at receivers, from positions."""
