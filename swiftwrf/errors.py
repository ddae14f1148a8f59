"""The two ways this package says no."""


class InputError(ValueError):
    """Wrong input: one sentence saying what was expected, what came and what to do.

    Commands print the sentence and exit with code 2.
    """


class FitError(RuntimeError):
    """A fit that cannot go on; the last good state is kept on disk where a checkpoint path was given."""
