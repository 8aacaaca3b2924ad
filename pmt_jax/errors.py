"""The one exception that the command line prints as a sentence, without a traceback."""

import importlib
import types


class UsageError(ValueError):
    """A user's mistake, in one sentence: what was wrong, what was expected, what to do. Exit code 2."""


def optional(module: str, extra: str) -> types.ModuleType:
    """Imports a package that pmt-jax can do without.

    Raises:
      UsageError: it is not installed; says which of our extras brings it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        package = module.split(".")[0]
        raise UsageError(f"this needs {package}, which is missing here: pip install 'pmt-jax[{extra}]'") from error
