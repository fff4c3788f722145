"""`optimize` stands on public names of `jaxclamp`, and its imports point down only.

A new module gets a line in `LEVEL`.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import jaxclamp

ROOT = Path(__file__).parents[2]

LEVEL = {
    "drivers": 0,
    "journal": 0,
    "gains": 0,
    "numbers": 0,
    "keys": 0,
    "named_measures": 1,
    "variables": 0,
    "problem": 1,
    "price": 2,
    "record": 2,
    "verification": 3,
    "evaluator": 3,
    "resuming": 3,
    "starts": 4,
    "study": 5,
    "figures": 6,
    "front": 6,
    "front_report": 7,
    "study_file": 7,
    "report": 8,
    "comparison": 2,
    "comparison_report": 7,
    "sweep_file": 1,
    "sweep_worker": 0,
    "sweep_folder": 2,
    "sweep": 3,
    "sweep_report": 7,
    "fit_header": 0,
    "fit_parameters": 0,
    "fit_data": 1,
    "fit_model": 2,
    "fit_search": 3,
    "fit_confidence": 4,
    "fit": 5,
    "fit_report": 7,
    "__init__": 9,
}

MODULES = sorted(path.stem for path in (ROOT / "optimize").rglob("*.py"))

# what only some modules may import
CONFINED = {
    "jaxopt": {"drivers"},
    "nlopt": {"drivers"},
    "optax": {"drivers"},
    "scipy.optimize": {"drivers"},
    "matplotlib": {"figures"},
}

OPEN_ROOMS = ("jaxclamp.scenes", "jaxclamp.pictures", "jaxclamp.show")
"""rooms of data and of what is shown, beside the names of jaxclamp itself"""
MOST_LINES = 400


def imported(tree: ast.AST) -> list[tuple[str, str]]:
    """Module and name of every import, also inside functions; no name where the module itself is imported.

    Of `import jaxclamp as jc`, every `jc.NAME` counts as an import of NAME; of what `from` imports, only
    private attributes do (public ones may be of a class).
    """
    found: list[tuple[str, str]] = []
    modules, things = {}, {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [(alias.name, "") for alias in node.names]
            modules |= {alias.asname or alias.name: alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found += [("." * node.level + (node.module or ""), alias.name) for alias in node.names]
            things |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            owner = node.value.id
            if owner in modules or (owner in things and is_private(node.attr)):
                found.append((modules.get(owner) or things[owner], node.attr))
    return found


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.endswith("__")


def faults(name: str, source: str) -> list[str]:
    """What is wrong with the imports of a module of optimize, one sentence each."""
    if name not in LEVEL:
        return [f"optimize/{name}.py has no level: add it to LEVEL in {Path(__file__).name}"]
    said = [_fault(name, module, what) for module, what in imported(ast.parse(source))]
    return [sentence for sentence in said if sentence]


def _fault(name: str, module: str, what: str) -> str | None:
    package = module.partition(".")[0]
    if package == "":
        return f"{name} imports {module}: write imports in full"
    if package == "optimize":
        return _not_below(name, module, what)
    if package == "jaxclamp":
        return _not_public(name, module, what)
    for confined, users in CONFINED.items():
        whole = f"{module}.{what}" if what else module
        if f"{whole}.".startswith(f"{confined}.") and name not in users:
            return f"{name} imports {confined}, which is for {', '.join(sorted(users))}"
    return None


def _not_below(name: str, module: str, what: str) -> str | None:
    """Why an import from optimize is none that points down to a public name."""
    _, _, inside = module.partition(".")
    target = inside.partition(".")[0] or (what if what in LEVEL else "__init__")
    if target not in LEVEL:
        return f"{name} imports {module}, which has no level"
    if LEVEL[target] >= LEVEL[name]:
        return f"{name} (level {LEVEL[name]}) imports {target} (level {LEVEL[target]}): imports point down"
    return f"{name} imports {what} of {target}, which is private" if is_private(what) else None


def _not_public(name: str, module: str, what: str) -> str | None:
    """Why an import from jaxclamp is none of a public name."""
    if module == "jaxclamp":
        known = not what or what in jaxclamp.__all__
        return None if known else f"{name} imports {what}, which is not in jaxclamp.__all__"
    if not any(f"{module}.".startswith(f"{room}.") for room in OPEN_ROOMS):
        return f"{name} imports {module}: take public names from jaxclamp or {', '.join(OPEN_ROOMS)}"
    private = any(part.startswith("_") for part in (*module.split("."), what))
    return f"{name} imports {what} of {module}, which is private" if private else None


def source(name: str) -> str:
    return (ROOT / "optimize" / f"{name}.py").read_text(encoding="utf-8")


def test_every_level_is_of_a_module():
    assert set(LEVEL) == set(MODULES)


@pytest.mark.parametrize("name", MODULES)
def test_imports_point_down_to_public_names(name):
    assert faults(name, source(name)) == []


@pytest.mark.parametrize("name", MODULES)
def test_a_module_is_one_idea(name):
    assert len(source(name).splitlines()) <= MOST_LINES
    assert ast.get_docstring(ast.parse(source(name)))


@pytest.mark.parametrize("name", MODULES)
def test_public_names_say_what_they_are(name):
    tree = ast.parse(source(name))
    owners = [tree, *(node for node in tree.body if isinstance(node, ast.ClassDef))]
    named = [
        node for owner in owners for node in owner.body if isinstance(node, ast.FunctionDef | ast.ClassDef)
    ]
    silent = [node.name for node in named if not node.name.startswith("_") and not ast.get_docstring(node)]
    assert silent == []


def test_jaxopt_is_imported_by_one_module_of_optimize_and_none_of_jaxclamp():
    def users(package: str) -> list[str]:
        trees = {path: ast.parse(path.read_text("utf-8")) for path in (ROOT / package).rglob("*.py")}
        return [
            path.stem
            for path, tree in trees.items()
            if any(module.partition(".")[0] == "jaxopt" for module, _ in imported(tree))
        ]

    assert users("optimize") == ["drivers"]
    assert users("jaxclamp") == []


@pytest.mark.parametrize("package", ["jaxclamp", "optimize"])
def test_what_draws_or_optimises_is_imported_when_it_is_needed(package):
    heavy = ("matplotlib", "jaxopt", "nlopt", "optax", "meshio", "h5py")
    asked = f"import sys, {package}; print(*sorted(set({heavy}) & set(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", asked], capture_output=True, text=True, cwd=ROOT, timeout=120, check=True
    )
    assert done.stdout.split() == []


@pytest.mark.parametrize("name", sorted(set(jaxclamp.__all__)))
def test_public_names_of_jaxclamp_exist(name):
    assert hasattr(jaxclamp, name)


# --- the checker itself ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("from optimize.study import Study", "imports point down"),
        ("from optimize.evaluator import Evaluator", "imports point down"),
        ("import optimize.study", "imports point down"),
        ("import optimize", "imports point down"),
        ("from optimize import minimise", "imports point down"),
        ("from optimize import study", "imports point down"),
        ("from optimize.nowhere import thing", "has no level"),
        ("from optimize.record import _evaluation", "is private"),
        ("from optimize import record\nrecord._evaluation({})", "is private"),
        ("from .record import Record", "write imports in full"),
        ("from jaxclamp.sensitivity.adjoint import value_and_gradient", "take public names"),
        ("import jaxclamp.solve.clamping", "take public names"),
        ("from jaxclamp import solve", "not in jaxclamp.__all__"),
        ("import jaxclamp as jc\njc.solve.clamping.clamp", "not in jaxclamp.__all__"),
        ("from jaxclamp.show.console import _finite", "is private"),
        ("from jaxclamp.show import console\nconsole._finite(1.0)", "is private"),
        ("from jaxclamp import Result\nResult._stage", "take public names"),
        ("from jaxclamp.showroom import lamp", "take public names"),
        ("import jaxopt", "is for drivers"),
        ("from scipy.optimize import minimize", "is for drivers"),
        ("from scipy import optimize", "is for drivers"),
        ("def f():\n    import nlopt", "is for drivers"),
    ],
)
def test_the_checker_reports(line, said):
    found = faults("evaluator", line)
    assert any(said in sentence for sentence in found), found


@pytest.mark.parametrize(
    "line",
    [
        "from jaxclamp import clamp",
        "import jaxclamp as jc\njc.clamp",
        "from jaxclamp import Result\nResult.measure.__name__",
        "from optimize.drivers import METHODS\nMETHODS.items()",
        "from jaxclamp.show.console import as_json",
        "from optimize.record import Record",
        "import scipy.stats",
        "from scipy import stats",
    ],
)
def test_the_checker_lets_pass(line):
    assert faults("evaluator", line) == []


def test_the_checker_asks_for_a_level():
    assert "has no level" in faults("attic", "")[0]
