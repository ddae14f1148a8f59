"""Names and limits that options of commands share with the functions they call. Imports no torch."""

AUTO = "auto"  # the field model that cross-validation chooses
MAX_SUGGESTIONS = 500  # positions to measure next
MAX_STATIONS = 24  # poses of a next array


def fraction_key(fraction: float) -> str:
    """Return the shortest text that reads back as the same number, for keys and file names.

    Example:
        >>> fraction_key(0.3), fraction_key(1.0), fraction_key(0.6666667)
        ('0.3', '1', '0.6666667')
    """
    short = f"{fraction:g}"
    return short if float(short) == fraction else repr(fraction)
