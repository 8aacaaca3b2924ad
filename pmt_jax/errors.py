"""The one exception that the command line answers with a sentence instead of a traceback."""


class UsageError(ValueError):
    """A user's mistake, told in one sentence: what was wrong, what was expected, what to do. Exit code 2."""
