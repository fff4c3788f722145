"""Imports point down only. A new module gets a line in `LEVEL`."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "jaxclamp"

LEVEL = {
    "pytree": 0,
    "worker": 0,
    "tensors": 0,
    "presets": 0,
    "console": 0,
    "elements": 1,
    "materials": 1,
    "jaws": 1,
    "contact": 1,
    "schema": 1,
    "scene": 2,
    "meshes": 3,
    "scene_checks": 3,
    "energies": 4,
    "inflation": 4,
    "scene_file": 4,
    "assembly": 5,
    "linear_solvers": 6,
    "measures": 6,
    "equilibrium": 7,
    "model": 7,
    "fields": 8,
    "objectives": 8,
    "transfer": 8,
    "plots": 9,
    "results": 10,
    "clamping": 11,
    "errors": 12,
    "paraview": 12,
    "sensitivity": 12,
    "accuracy": 13,
    "adjoint": 13,
    "report": 13,
    "export": 14,
    "price_report": 15,
    "cli": 16,
    "__init__": 17,
    "__main__": 17,
}

MODULES = sorted(path.relative_to(PACKAGE).with_suffix("").parts for path in PACKAGE.rglob("*.py"))

# third-party package: the modules that may import it
CONFINED = {
    "matplotlib": {"plots", "report"},
    "pyvista": {"plots", "report"},
    "meshio": {"export", "paraview"},
    "typer": {"cli"},
    "optimize": {"cli"},
}


def imports(path: Path) -> set[str]:
    """Dotted names of everything a file imports, also inside functions."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name} line {node.lineno}: write imports in full"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def source(module: tuple[str, ...]) -> Path:
    return PACKAGE.joinpath(*module).with_suffix(".py")


def test_the_package_is_found():
    assert ("tensors",) in MODULES


@pytest.mark.parametrize("module", MODULES, ids=".".join)
def test_imports_point_down(module):
    name = module[0]
    assert name in LEVEL, f"jaxclamp/{'/'.join(module)}.py has no level: add '{name}' to LEVEL in {__file__}"
    for imported in imports(source(module)):
        package, _, rest = imported.partition(".")
        if package != "jaxclamp":
            continue
        target = rest.split(".")[0]
        if target == "__version__":
            continue
        assert target in LEVEL, f"{name} imports {imported}, which is no module of jaxclamp with a level"
        if target == name and len(module) > 1:
            continue  # files of one sub-package
        assert LEVEL[target] < LEVEL[name], (
            f"{name} (level {LEVEL[name]}) imports {target} (level {LEVEL[target]}): imports point down only"
        )


@pytest.mark.parametrize("package", CONFINED)
def test_heavy_packages_are_confined(package):
    users = {m[0] for m in MODULES if any(name.split(".")[0] == package for name in imports(source(m)))}
    assert users <= CONFINED[package], f"{package} is imported by {sorted(users - CONFINED[package])}"


def test_jaxopt_is_imported_by_one_module_at_most():
    users = [m for m in MODULES if any(name.split(".")[0] == "jaxopt" for name in imports(source(m)))]
    assert len(users) <= 1, f"jaxopt is imported by {users}"
