"""Files that are either whole or not there."""

from __future__ import annotations

import contextlib
import pathlib
from collections.abc import Iterator

from .errors import UsageError


@contextlib.contextmanager
def writing(out: pathlib.Path) -> Iterator[pathlib.Path]:
    """A file beside `out` to write to, which takes the place of `out` when all has gone well.

    Raises:
      UsageError: the folder cannot be written.
    """
    partial = out.with_stem(f".{out.stem}.partial")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        partial.replace(out)
    except OSError as error:
        raise UsageError(f"cannot write {out}: {error.strerror or error}; choose another -o") from error
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
