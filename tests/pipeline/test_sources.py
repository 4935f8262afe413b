"""A stage runs again if, and only if, a source changed that it can reach."""

import ast
import functools
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from pipeline import runner, sources
from pipeline.runner import run_campaign
from pipeline.sources import ROOT, all_modules, code_version, reachable
from pipeline.stages.registry import STAGES

STAGE_MODULES = [stage.module for stage in STAGES]
MODULES = frozenset(all_modules())


def file_of(module: str, root: Path = ROOT) -> Path:
    place = root.joinpath(*module.split("."))
    return place / "__init__.py" if place.is_dir() else place.with_suffix(".py")


@functools.cache
def imports_by_parser(module: str) -> frozenset[str]:
    """Modules that one module imports: an independent count with Python's own parser, without those for types."""
    names = {module.rsplit(".", n)[0] for n in range(module.count(".") + 1)}
    for node in running(ast.parse(file_of(module).read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, "relative imports are not used here"
            names |= {str(node.module), *(f"{node.module}.{alias.name}" for alias in node.names)}
    names |= {name.rsplit(".", n)[0] for name in names for n in range(name.count(".") + 1)}
    return frozenset(names & MODULES)


def running(node: ast.AST) -> Iterator[ast.AST]:
    yield node
    typing = isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
    for child in [] if typing else ast.iter_child_nodes(node):
        yield from running(child)


@functools.cache
def reached(module: str) -> frozenset[str]:
    found, waiting = set(), {module}
    while waiting:
        found |= waiting
        waiting = {name for one in waiting for name in imports_by_parser(one)} - found
    return frozenset(found)


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A copy of the sources."""
    for package in sources.PACKAGES:
        shutil.copytree(ROOT / package, tmp_path / "tree" / package, ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path / "tree"


def change(module: str, root: Path) -> None:
    with file_of(module, root).open("ab") as stream:
        stream.write(b"#")
    code_version.cache_clear()


@pytest.mark.parametrize("stage", STAGE_MODULES)
def test_reach_of_a_stage(stage: str) -> None:
    assert reachable(stage) == reached(stage)


def test_version_follows_every_module_in_reach_and_no_other(tree: Path) -> None:
    stage = "pipeline.stages.frames"
    version = code_version(stage, root=tree)
    assert version == code_version(stage)
    for module in set(all_modules()) - reached(stage):
        change(module, tree)
    assert code_version(stage, root=tree) == version
    for module in reached(stage):
        change(module, tree)
        before, version = version, code_version(stage, root=tree)
        assert version != before, module


def test_what_is_really_imported_is_in_reach() -> None:
    script = "import sys, pipeline.stages.diagnose; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    own = {name for name in loaded.stdout.split() if name.split(".")[0] in sources.PACKAGES}
    assert "robcal.transforms" in own
    assert own <= reachable("pipeline.stages.diagnose")


def test_results_depend_on_no_report_and_no_command_line() -> None:
    for stage in STAGE_MODULES[:-1]:
        assert not [name for name in reachable(stage) if name.startswith(("pipeline.report", "pipeline.cli"))]
    assert "pipeline.report.verdict" in reachable(STAGE_MODULES[-1])  # imported inside a function


def test_data_beside_the_sources_count(tree: Path) -> None:
    before = code_version("pipeline.stages.report", root=tree)
    with next((tree / "pipeline" / "report").glob("*.css")).open("a") as stream:
        stream.write("\n")
    code_version.cache_clear()
    assert code_version("pipeline.stages.report", root=tree) != before


def test_a_run_repeats_the_stages_whose_sources_changed(
    point_campaign: Path, tmp_path: Path, tree: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner, "code_version", functools.partial(code_version, root=tree))
    out = tmp_path / "run"
    assert run_campaign(point_campaign, out, until="frames").ran == ("measure", "frames")
    change("pipeline.report.verdict", tree)
    assert run_campaign(point_campaign, out, until="frames").ran == ()
    change("robcal.transforms", tree)
    assert run_campaign(point_campaign, out, until="frames").ran == ("measure", "frames")
    change("pipeline.stages.frames", tree)
    assert run_campaign(point_campaign, out, until="frames").ran == ("frames",)
    with pytest.raises(ModuleNotFoundError, match="no module robcal"):
        code_version("robcal.no_such", root=tree)
