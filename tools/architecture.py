"""The picture of docs/architecture.md, drawn from the imports: `python -m tools.architecture [--check]`.

Packages stand in the layers that the import rules of pyproject.toml give them; an arrow says that modules of one import
modules of another (those that follow from others are left out).
"""

import argparse
import html
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import grimp

ROOT = Path(__file__).resolve().parent.parent
PICTURE = ROOT / "docs" / "images" / "architecture.svg"
BOX, ROW, MARGIN = (150, 34), 64, 30


def layers() -> list[tuple[str, ...]]:
    """Packages from the top, as the import rules order them."""
    rules = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]["contracts"]
    library = next(rule["layers"] for rule in rules if rule["name"] == "robcal layers")
    return [("pipeline",), *((name,) for name in library)]


def imports(packages: Iterable[str]) -> dict[tuple[str, str], int]:
    """Numbers of imports from each package to each other one."""
    graph = grimp.build_graph("robcal", "pipeline", cache_dir=None)
    home = {m: package for package in packages for m in graph.modules if m == package or m.startswith(package + ".")}
    found: dict[tuple[str, str], int] = {}
    for module, package in home.items():
        for used in graph.find_modules_directly_imported_by(module):
            other = home.get(used)
            if other is not None and other != package:
                found[package, other] = found.get((package, other), 0) + 1
    return found


def reduced(arrows: Mapping[tuple[str, str], int]) -> set[tuple[str, str]]:
    """Arrows without those that follow from others."""
    uses: dict[str, set[str]] = {}
    for a, b in arrows:
        uses.setdefault(a, set()).add(b)

    def reaches(a: str, b: str) -> bool:
        return any(c == b or reaches(c, b) for c in uses.get(a, ()))

    return {(a, b) for a, b in arrows if not any(c != b and reaches(c, b) for c in uses[a])}


def size(package: str) -> tuple[int, int]:
    """Modules and lines."""
    place = ROOT / package.replace(".", "/")
    files = [place.with_suffix(".py")] if place.with_suffix(".py").is_file() else sorted(place.rglob("*.py"))
    files = [file for file in files if file.name != "__init__.py"]
    return len(files), sum(len(file.read_text(encoding="utf-8").splitlines()) for file in files)


def picture(rows: Sequence[tuple[str, ...]], arrows: Iterable[tuple[str, str]]) -> str:
    """SVG: a column of packages, arrows to the next ones straight, longer ones round the side."""
    names = [name for row in rows for name in row]
    at = {name: (MARGIN + 130, MARGIN + ROW * k) for k, name in enumerate(names)}
    shapes = []
    side = 0
    for a, b in sorted(arrows, key=lambda pair: (names.index(pair[0]), names.index(pair[1]))):
        (x, y), (_, v) = at[a], at[b]
        if names.index(b) == names.index(a) + 1:
            path = f"M{x + BOX[0] / 2} {y + BOX[1]} V{v - 4}"
        else:
            side += 1
            out = x + BOX[0] + 14 + 11 * (side % 9)
            path = f"M{x + BOX[0]} {y + BOX[1] / 2 + 5} H{out} V{v + BOX[1] / 2 - 5} H{x + BOX[0] + 4}"
        shapes.append(f'<path d="{path}" fill="none" stroke="#7a8594" marker-end="url(#tip)"/>')
    for name, (x, y) in at.items():
        modules, _ = size(name)
        shapes.append(
            f'<rect x="{x}" y="{y}" width="{BOX[0]}" height="{BOX[1]}" rx="5" fill="#eef3f8" stroke="#3b5b7d"/>'
            f'<text x="{x + BOX[0] / 2}" y="{y + 22}" text-anchor="middle">{html.escape(name)}</text>'
            f'<text x="{x - 8}" y="{y + 22}" text-anchor="end" fill="#7a8594">{modules} modules</text>'
        )
    height = 2 * MARGIN + ROW * len(names) - ROW + BOX[1]
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 480 {height}" font-family="sans-serif" font-size="12">'
        '<defs><marker id="tip" markerWidth="8" markerHeight="8" refX="6" refY="3" orient="auto">'
        '<path d="M0 0 L6 3 L0 6 z" fill="#7a8594"/></marker></defs>'
    )
    return "\n".join([head, *shapes, "</svg>", ""])


def drawn() -> str:
    """The picture as the imports are now."""
    rows = layers()
    packages = [name for row in rows for name in row]
    return picture(rows, reduced(imports(packages)))


def main() -> int:
    """Write the picture, or say whether it is up to date."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="exit code 1 if the picture's arrows are out of date")
    given = parser.parse_args()
    if given.check:
        return int(not PICTURE.is_file() or arrows_of(PICTURE.read_text(encoding="utf-8")) != arrows_of(drawn()))
    PICTURE.write_text(drawn(), encoding="utf-8")
    return 0


def arrows_of(text: str) -> list[str]:
    """Lines of the picture that are arrows."""
    return [line for line in text.splitlines() if line.startswith("<path")]


if __name__ == "__main__":
    raise SystemExit(main())
