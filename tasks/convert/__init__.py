"""Convert measurements of any known format to the toolkit's own layout."""
