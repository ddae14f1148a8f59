"""A page to explore a fitted model in the browser, served on this machine."""
