# `make test` checks everything; `make demo` designs a jaw. Needs Python 3.11 or newer, and make.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
OUT ?= demo

# Compiled kernels are kept between runs; deleting the folder costs time, nothing else.
export JAX_COMPILATION_CACHE_DIR ?= $(CURDIR)/.cache/jax
export JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS ?= 0

.PHONY: test lint pytest slow bench demo clean help
.DEFAULT_GOAL := help

help:
	@echo "make test    lint, types and tests (creates $(VENV) on first use)"
	@echo "make demo    find the jaw that injures a human coronary artery least and presses no harder than a cylinder, into $(OUT)/ (minutes)"
	@echo "make lint    lint, formatting and types only"
	@echo "make slow    the tests that take more than a few seconds each"
	@echo "make bench   timings"
	@echo "make clean   remove $(VENV), caches and results"

$(READY): pyproject.toml requirements.lock
	@$(PYTHON) -c 'import sys; sys.exit("jaxclamp needs Python 3.11 or newer, and $(PYTHON) is " + sys.version.split()[0] + "; try: make PYTHON=python3.12") if sys.version_info < (3, 11) else None'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint requirements.lock --editable '.[dev]'
	@touch $@

test: lint pytest

lint: $(READY)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

# two processes, a file of tests to each at a time: files share compiled programs and solutions
pytest: $(READY)
	$(BIN)/pytest --numprocesses 2 --dist loadfile

slow: $(READY)
	$(BIN)/pytest -m slow

bench: $(READY)
	$(BIN)/pytest -m benchmark -s

demo: $(READY)
	$(BIN)/jaxclamp optimise human-lad-jaw --out $(OUT) --resume
	@echo
	@echo "Open $(OUT)/report.html in a browser; the numbers are in $(OUT)/study.json and $(OUT)/iterations.csv."
	@echo "Open the .pvd file in $(OUT)/best/ with ParaView to see the artery in 3-D."

clean:
	rm -rf $(VENV) .cache .mypy_cache .pytest_cache .ruff_cache .hypothesis build dist demo
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
