"""Records to figures and one self-contained HTML page; knows no task."""
