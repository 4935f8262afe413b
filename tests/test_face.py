"""What `import robcal` gives: every public name is there, documented, loaded when asked for, and typed."""

import ast
import dataclasses
import inspect
import subprocess
import sys
from pathlib import Path

import pytest

import robcal
from pipeline.sources import ROOT, all_modules

FACE = Path(robcal.__file__)


@pytest.mark.parametrize("name", [name for name in robcal.__all__ if name != "__version__"])
def test_public_names_are_documented(name: str) -> None:
    value = getattr(robcal, name)
    assert value.__module__.startswith("robcal.")
    text = inspect.getdoc(value) or ""
    assert len(text) > 20
    assert not (dataclasses.is_dataclass(value) and text.startswith(f"{name}(")), "the docstring is the generated one"
    with pytest.raises(AttributeError, match="no attribute"):
        getattr(robcal, name + "_")


def test_type_checkers_see_the_same_names() -> None:
    tree = ast.parse(FACE.read_text())
    typing = next(node for node in tree.body if isinstance(node, ast.If))
    seen = {f"{node.module}.{a.name}" for node in typing.body if isinstance(node, ast.ImportFrom) for a in node.names}
    assert seen == {f"{home}.{name}" for name, home in robcal._MODULE_OF.items()}
    assert FACE.with_name("py.typed").is_file()


def test_importing_loads_nothing_heavy() -> None:
    script = "import sys, robcal; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout.split()
    assert not {"numpy", "scipy", "cv2", "casadi", "pydantic"} & set(loaded)


def test_the_project_itself_imports_from_the_modules() -> None:
    """Else a stage would not be seen to depend on what it uses (see pipeline.sources)."""
    for module in all_modules():
        path = ROOT.joinpath(*module.split("."))
        file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module == "robcal":
                assert not {alias.name for alias in node.names} & set(robcal.__all__), module
