"""Which source files a module can reach through its imports: what a stage's results depend on, and their hash.

Sources are read, not imported, and import statements found by their lines: parsing all of them takes seconds. Imports
inside functions and conditions count, those for type checkers alone do not.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

PACKAGES = ("robcal", "pipeline")
ROOT = Path(__file__).parent.parent
"""Folder that holds both packages."""

_IMPORT = re.compile(r"^[ \t]*(?:from (\.*)([\w.]*) import (\([^)]*\)|.*)|import (.*))$", re.MULTILINE)
_TYPES_ONLY = re.compile(r"^if TYPE_CHECKING:.*\n(?:[ \t].*\n|\n)*", re.MULTILINE)


@cache
def code_version(*modules: str, root: Path = ROOT) -> str:
    """Hash of all sources that some modules can reach, and of the data files beside them (templates, C sources)."""
    digest = hashlib.sha256()
    for name in sorted(reachable(*modules, root=root)):
        for file in _files(name, root):
            digest.update(file.relative_to(root).as_posix().encode())
            digest.update(file.read_bytes())
    return digest.hexdigest()


def reachable(*modules: str, root: Path = ROOT) -> frozenset[str]:
    """Modules of this project that some modules import, directly or through others; themselves included."""
    found: set[str] = set()
    waiting = list(modules)
    while waiting:
        name = waiting.pop()
        if name not in found:
            found.add(name)
            waiting += imported(name, root)
    return frozenset(found)


def all_modules(root: Path = ROOT) -> tuple[str, ...]:
    """All modules of this project."""
    files = (file.relative_to(root).with_suffix("") for top in PACKAGES for file in (root / top).rglob("*.py"))
    return tuple(sorted(".".join(f.parts[:-1] if f.name == "__init__" else f.parts) for f in files))


@cache
def imported(module: str, root: Path = ROOT) -> tuple[str, ...]:
    """Modules of this project that one module imports itself, with the packages that hold them."""
    path = _required(module, root)
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    names = {package} - {""}
    for dots, origin, members, plain in _IMPORT.findall(_TYPES_ONLY.sub("", path.read_text(encoding="utf-8"))):
        base = package.split(".")[: 1 - len(dots) or None] if dots else []
        origin = ".".join(filter(None, (*base, origin)))
        named = [part.split()[0] for part in re.sub(r"#.*|[()]", "", members or plain).split(",") if part.strip()]
        names.update((origin, *(f"{origin}.{name}" for name in named)) if members else named)
    holders = {name.rsplit(".", n)[0] for name in names for n in range(name.count(".") + 1)}
    return tuple(sorted(n for n in holders if n.split(".")[0] in PACKAGES and _source(n, root) is not None))


@cache
def _source(module: str, root: Path) -> Path | None:
    place = root.joinpath(*module.split("."))
    return next((p for p in (place / "__init__.py", place.with_suffix(".py")) if p.is_file()), None)


def _required(module: str, root: Path) -> Path:
    path = _source(module, root)
    if path is None:
        raise ModuleNotFoundError(f"no module {module} under {root}", name=module)
    return path


def _files(module: str, root: Path) -> Iterator[Path]:
    path = _required(module, root)
    yield path
    if path.name == "__init__.py":
        yield from sorted(p for p in path.parent.iterdir() if p.is_file() and p.suffix not in {".py", ".pyc", ".typed"})
