"""Imports point down only, from room to room and inside a room; heavy packages are confined.

A new room gets its place in `ROOMS`. The checkers are functions of sources, and are tested themselves.
"""

import ast
from collections.abc import Iterable, Mapping
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "jaxclamp"

ROOMS = (
    "core",
    "physics",
    "scenes",
    "specimens",
    "fem",
    "potential",
    "observe",
    "pictures",
    "solve",
    "sensitivity",
    "trust",
    "show",
    "cli",
    "",
)
"""from the ground up; "" is the package's own door, which opens on all of them"""

CONFINED = {
    "matplotlib": {"pictures", "show"},
    "meshio": {"show"},
    "contourpy": {"pictures"},
    "h5py": {"solve"},
    "typer": {"cli"},
    "rich": {"show"},
    "optimize": {"cli"},
    "jaxopt": set(),
    "optax": set(),
    "nlopt": set(),
}
"""third-party package: the rooms that may import it"""

LONGEST = 400
"""lines of a module"""


def imports(source: str) -> set[str]:
    """Dotted names of everything a source imports, also inside functions."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"line {node.lineno}: write imports in full"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def room_of(module: str) -> str:
    """The room of a module such as "solve.newton"; cli is a room of its own, the doors are ""."""
    first = module.split(".")[0]
    return "" if first in ("__init__", "__main__") else first


def sources(package: Path) -> dict[str, str]:
    """Text of each module by its dotted name below the package."""
    found = {}
    for path in sorted(package.rglob("*.py")):
        parts = path.relative_to(package).with_suffix("").parts
        name = ".".join(parts[:-1] if len(parts) > 1 and parts[-1] == "__init__" else parts)
        found[name] = path.read_text(encoding="utf-8")
    return found


def targets(source: str, known: Iterable[str], package: str = "jaxclamp") -> set[str]:
    """Modules of the package that a source imports."""
    modules = set(known)
    found = set()
    for name in imports(source):
        if name.split(".")[0] != package:
            continue
        rest = name.partition(".")[2]
        while rest and rest not in modules:
            rest = rest.rpartition(".")[0]
        found.add(rest or "__init__")
    return found


def upward(modules: Mapping[str, str]) -> list[str]:
    """Imports that do not point down, in words."""
    wrong = []
    for name, text in modules.items():
        for target in targets(text, modules):
            here, there = room_of(name), room_of(target)
            unknown = [room for room in (here, there) if room not in ROOMS]
            if unknown:
                wrong.append(f"{unknown[0]} is no room")
            elif here != there and ROOMS.index(there) >= ROOMS.index(here):
                wrong.append(f"{name} imports {target}: room '{there}' is not below '{here}'")
    return wrong


def circles(modules: Mapping[str, str]) -> list[str]:
    """Modules that import each other, by whatever way."""
    graph = {name: targets(text, modules) - {name, "__init__"} for name, text in modules.items()}
    state: dict[str, int] = {}
    found: list[str] = []

    def visit(name: str, path: tuple[str, ...]) -> None:
        state[name] = 1
        for target in sorted(graph.get(name, ())):
            if state.get(target) == 1:
                found.append(" -> ".join((*path[path.index(target) :], target)))
            elif target not in state:
                visit(target, (*path, target))
        state[name] = 2

    for name in graph:
        if name not in state:
            visit(name, (name,))
    return found


def users(modules: Mapping[str, str], package: str) -> set[str]:
    """Rooms whose modules import a package."""
    return {
        room_of(m) for m, text in modules.items() if any(n.split(".")[0] == package for n in imports(text))
    }


MODULES = sources(PACKAGE)


def test_the_package_is_found():
    assert {"core.tensors", "potential.terms", "solve.newton", "show.report", "cli"} <= set(MODULES)


def test_imports_point_down():
    assert upward(MODULES) == []


def test_no_modules_import_each_other():
    assert circles(MODULES) == []


@pytest.mark.parametrize("package", CONFINED)
def test_heavy_packages_are_confined(package):
    assert users(MODULES, package) <= CONFINED[package]


def test_modules_are_short():
    long = {name: n for name, text in MODULES.items() if (n := len(text.splitlines())) > LONGEST}
    assert long == {}


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("physics.jaws", "from jaxclamp.solve.newton import newton", "physics.jaws imports solve.newton"),
        ("fem.tube", "def f():\n    import jaxclamp.potential.terms", "fem.tube imports potential.terms"),
        ("solve.newton", "from jaxclamp import clamp", "solve.newton imports __init__"),
        ("attic.old", "from jaxclamp.core import records", "attic is no room"),
    ],
)
def test_the_checker_sees_what_it_is_for(name, text, said):
    made_up = {"core.records": "", "solve.newton": "", "potential.terms": "", "__init__": "", name: text}
    assert any(said in sentence for sentence in upward(made_up))


def test_the_checker_sees_circles():
    made_up = {
        "core.a": "from jaxclamp.core.b import x",
        "core.b": "from jaxclamp.core import c",
        "core.c": "import jaxclamp.core.a",
    }
    assert circles(made_up) == ["core.a -> core.b -> core.c -> core.a"]
    assert users({"core.a": "import matplotlib.pyplot"}, "matplotlib") == {"core"}


# --- words --------------------------------------------------------------------------------------------

PUBLIC_SHARE = 0.95
"""of the public names that have a docstring"""


def public_names(text: str) -> dict[str, bool]:
    """Public functions, classes, methods and fields of a source, and whether each is documented.

    A method that only fills in what an abstract base documents, an enum-like constant and a dunder count
    as nothing; a field is documented by the text below it, or if it bears the name of its class's tag.
    """
    found: dict[str, bool] = {}

    def visit(body: list[ast.stmt], prefix: str, in_class: bool, overrides: bool) -> None:
        for node, following in zip(body, [*body[1:], None], strict=False):
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                documented = ast.get_docstring(node) is not None
                if not (in_class and overrides and isinstance(node, ast.FunctionDef) and not documented):
                    found[f"{prefix}{node.name}"] = documented
                if isinstance(node, ast.ClassDef):
                    visit(node.body, f"{prefix}{node.name}.", True, bool(node.bases))
            elif in_class and isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                text_below = isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant)
                tag = isinstance(node.value, ast.Call) and bool(node.value.args)
                if not node.target.id.startswith("_"):
                    found[f"{prefix}{node.target.id}"] = text_below or tag

    visit(ast.parse(text).body, "", False, False)
    return found


def undocumented(modules: Mapping[str, str]) -> tuple[list[str], int]:
    """Public names without a docstring, and how many there are in all."""
    names = {f"{m}.{name}": good for m, text in modules.items() for name, good in public_names(text).items()}
    return [name for name, good in names.items() if not good], len(names)


@pytest.mark.parametrize("package", ["jaxclamp", "optimize"])
def test_public_names_are_documented(package):
    bare, total = undocumented(sources(ROOT / package))
    assert total > 50
    assert 1.0 - len(bare) / total >= PUBLIC_SHARE, bare


def test_the_count_of_documented_names_can_fail():
    assert public_names("class A:\n    x: int\n    '''d'''\n    y: int\n\ndef f(): ...") == {
        "A": False,
        "A.x": True,
        "A.y": False,
        "f": False,
    }
