"""What is shipped: every import is declared, the sources hold their docs, an index page has no dead links."""

import re
import sys
import tomllib
from pathlib import Path

import pytest

from test_layers import imports

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PACKAGES = ("jaxclamp", "optimize")
CALLED = {"pymklpardiso": "py-mkl-pardiso"}
"""imported name of what is distributed under another"""


def imported(package: str) -> set[str]:
    """Names of the packages that a package imports, other than Python's own."""
    texts = [path.read_text(encoding="utf-8") for path in (ROOT / package).rglob("*.py")]
    found = {name.split(".")[0] for text in texts for name in imports(text)}
    return found - set(sys.stdlib_module_names) - set(PACKAGES)


def declared() -> set[str]:
    project = PROJECT["project"]
    extras = project["optional-dependencies"]
    asked = [*project["dependencies"], *extras["mma"], *extras["sweep"]]
    return {re.split(r"[<>=; ]", line)[0] for line in asked}


def unmet(names: set[str]) -> set[str]:
    return {CALLED.get(name, name) for name in names} - declared()


@pytest.mark.parametrize("package", PACKAGES)
def test_every_import_is_declared(package):
    assert imported(package)
    assert unmet(imported(package)) == set()


def test_an_import_that_is_not_declared_is_seen():
    assert unmet({"numpy", "pandas"}) == {"pandas"}


@pytest.mark.parametrize("package", PACKAGES)
def test_types_are_shipped(package):
    assert (ROOT / package / "py.typed").is_file()


@pytest.mark.parametrize("name", ["/docs", "/notebooks", "/CITATION.cff", "/LICENSE"])
def test_the_source_distribution_holds_its_docs(name):
    assert name in PROJECT["tool"]["hatch"]["build"]["targets"]["sdist"]["include"]
    assert (ROOT / name[1:]).exists()


def index_page(text: str) -> str:
    """The README as a package index shows it."""
    for rule in PROJECT["tool"]["hatch"]["metadata"]["hooks"]["fancy-pypi-readme"]["substitutions"]:
        text = re.sub(rule["pattern"], rule["replacement"], text)
    return text


def test_the_page_of_a_package_index_has_no_dead_links():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    relative = re.compile(r"!?\[[^\]]*\]\((?!https?://|#)")
    assert relative.search(text)
    assert not relative.search(index_page(text))
    assert index_page("![a](b.png), [c.md](c.md), [d](e.md), [f](https://g)") == (
        "*(a: `b.png` in the source distribution)*, `c.md`, d (`e.md`), [f](https://g)"
    )


def test_the_citation_names_this_version():
    text = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"version: {PROJECT['project']['version']}\n" in text
    assert f"license: {PROJECT['project']['license']}\n" in text
