"""Which Python files (tasks, methods) may be executed: those whose content this user has run, or said to trust.

Whoever names a file on a command line wants it executed. A run folder, or a file of settings, may come from another
person and name any file, so the files that it names are executed only if their digest is known. Digests are kept in
`pmt-jax/trusted` of the user's state folder (XDG_STATE_HOME), one a line with the file that it was of; a line that is
deleted is no longer trusted.
"""

from __future__ import annotations

import ast
import contextlib
import contextvars
import hashlib
import importlib.machinery
import json
import os
import pathlib
from collections.abc import Iterable, Iterator

from .errors import UsageError
from .tasks import absolute, is_file, task_file

_OURS = ("envs", "pmt_jax")  # imported long before, so that no file next to a task's takes their place

_trusts = contextvars.ContextVar("trusts", default=False)


@contextlib.contextmanager
def trusting(trust: bool = True) -> Iterator[None]:
    """Inside, files that runs and settings name may be executed, and are known from then on."""
    token = _trusts.set(trust or _trusts.get())
    try:
        yield
    finally:
        _trusts.reset(token)


def check_source(source: str, names: Iterable[str], methods: Iterable[str] = ()) -> None:
    """What a command line names: Python files become known; of a file of settings, the files that it names must be.

    Args:
      names: the tasks and methods that `source` makes, as in a run's settings.
      methods: those that the command line names itself.

    Raises:
      UsageError: the settings name a Python file that is not known.
    """
    own = [absolute(name) for name in (source, *methods) if is_file(name)]
    for name in own:
        remember(name)
    settings = pathlib.Path(source)
    for task in dict.fromkeys(name for name in names if name not in own):
        check(task, f"{source} names", settings.parent if settings.name == "config.toml" else None)


def check(task: str, named_by: str, run: pathlib.Path | None = None) -> None:
    """Refuses a task whose Python file is not known, or lies in the run folder that names it.

    Inside `trusting` it becomes known instead. Tasks that are no files, and files that do not exist, execute nothing.

    Args:
      named_by: the beginning of the sentence, up to the file.
      run: the run folder.

    Raises:
      UsageError: the file would be executed, and is not trusted.
    """
    if not is_file(task):
        return
    if _trusts.get():
        remember(task)
        return
    file = task_file(task)
    if not file.is_file():
        return
    if run is not None and _inside(file, run):
        why = "it lies in the run folder and may have come with it"
    elif not _is_known(file):
        why = "you have not trained with it as it is now"
    else:
        return
    raise UsageError(
        f"{named_by} {file}, whose code would be executed, but {why}; read it, and add --trust (in Python: trust=True) "
        "if you trust it"
    )


def remember(task: str) -> None:
    """Makes the Python file of a task known to this user; where no file can be written it has to be trusted again."""
    file = task_file(task)
    if not file.is_file() or _is_known(file):
        return
    place = _place()
    with contextlib.suppress(OSError):  # a home that is read-only, full or not there
        if place is not None:
            place.parent.mkdir(parents=True, exist_ok=True)
            with place.open("a") as known:
                known.write(f"{digest(file)}  {json.dumps(str(file))}\n")  # one write, which others cannot split


def digest(file: pathlib.Path) -> str:
    """SHA-256 of a Python file and of all that it may load from next to it.

    That is: modules in the file's folder that it imports, and Python files that it names as text; of each, the same.
    They are found by reading, so that nothing is executed. What a file composes at run time cannot be found.
    """
    found: dict[pathlib.Path, bytes] = {}
    todo = [file]
    while todo:
        path = todo.pop()
        if path not in found:
            found[path] = path.read_bytes()
            todo += _named_in(found[path], path, file.parent)
    parts = sorted((os.path.relpath(path, file.parent), content) for path, content in found.items() if path != file)
    whole = hashlib.sha256(hashlib.sha256(found[file]).digest())  # its name says nothing, theirs do
    for name, content in parts:
        whole.update(hashlib.sha256(os.fsencode(name)).digest() + hashlib.sha256(content).digest())
    return whole.hexdigest()


def _named_in(content: bytes, path: pathlib.Path, top: pathlib.Path) -> list[pathlib.Path]:
    """The files that the source in `path` names, as far as they lie next to it, or next to the task's in `top`."""
    try:
        nodes = list(ast.walk(ast.parse(content)))
    except (SyntaxError, ValueError, RecursionError, MemoryError):  # it cannot be executed either
        return []
    files = []
    for node in nodes:
        if isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            modules = [base, *(f"{base}.{alias.name}".strip(".") for alias in node.names)]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.endswith(".py"):
            files += [folder / node.value for folder in {path.parent, top} if not os.path.isabs(node.value)]
            continue
        else:
            continue
        level = getattr(node, "level", 0)
        folders = set(path.parents[level - 1 : level]) if level else {path.parent, top}
        names = [name for name in modules if name and (level or name.split(".")[0] not in _OURS)]
        files += [file for folder in folders for name in names for file in _modules(folder, name)]
    return [file for file in files if os.path.isfile(file)]  # which is false for names that no file can have


def _modules(folder: pathlib.Path, name: str) -> Iterator[pathlib.Path]:
    """Where the module `name` and the packages around it could be, below `folder`."""
    parts = name.split(".")
    for count in range(1, len(parts) + 1):
        place = folder.joinpath(*parts[:count])
        for suffix in importlib.machinery.all_suffixes():
            yield from (place.with_name(place.name + suffix), place / f"__init__{suffix}")


def _inside(file: pathlib.Path, run: pathlib.Path) -> bool:
    """Whether `file`, as it is named or through any of its links, lies in the folder `run`."""
    for _ in range(40):  # as many links as Linux follows
        named, real = pathlib.Path(os.path.abspath(file)), file.parent.resolve() / file.name
        for parent in (*named.parents, *real.parents):
            if parent.exists() and parent.samefile(run):
                return True
        if not file.is_symlink():
            return False
        file = file.parent / file.readlink()
    return True


def _place() -> pathlib.Path | None:
    """The file of what is known; None for a user without a home."""
    chosen = os.environ.get("XDG_STATE_HOME", "")
    try:  # by the XDG standard, a path that is empty or relative does not count
        home = pathlib.Path(chosen) if os.path.isabs(chosen) else pathlib.Path.home() / ".local" / "state"
    except RuntimeError:
        return None
    return home / "pmt-jax" / "trusted"


def _is_known(file: pathlib.Path) -> bool:
    place = _place()
    try:
        lines = place.read_text(errors="replace").splitlines() if place else []
    except OSError:
        return False
    return digest(file) in {line.partition(" ")[0] for line in lines}
