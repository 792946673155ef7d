# Two commands do all the set-up: `make demo` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo test evidence lint docs dist benchmark clean

demo: $(VENV)/.installed
	$(BIN)/rendezview demo

# In an order that is drawn anew; `make test PYTEST=--randomly-seed=SEED` repeats one.
test: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -n auto --dist loadfile --max-worker-restart 1 $(PYTEST)

# Requirements, the tests that verify them, and their results; fails where one is not verified.
evidence: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -n auto --dist loadfile --max-worker-restart 1 -m requirement --evidence

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# The site, in build/site; a warning is an error. The notebook is run.
docs: $(VENV)/.installed-docs
	$(BIN)/python -m sphinx -q -W --keep-going -c docs/site -d build/doctrees docs build/site

# Wheel and sdist, in dist, checked as they would be published.
dist: $(VENV)/bin/pip
	$(BIN)/python -m pip install --quiet --group release
	rm -rf dist
	$(BIN)/python -m build --quiet
	$(BIN)/twine check --strict dist/*
	$(BIN)/check-wheel-contents dist/*.whl

# The short form beside the ratios that are kept in benchmark.json; three minutes, on a quiet machine.
benchmark: $(VENV)/.installed-dev
	$(BIN)/python -m experiments benchmark --short --check benchmark.json

$(VENV)/bin/pip:
	$(PYTHON) -c 'import sys; sys.exit("rendezview needs Python 3.11 or newer, this is " + sys.version.split()[0] + "; set PYTHON=python3.11") if sys.version_info < (3, 11) else None'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip

$(VENV)/.installed: pyproject.toml | $(VENV)/bin/pip
	$(BIN)/python -m pip install --quiet --editable '.[all]'
	touch $@

$(VENV)/.installed-dev: pyproject.toml $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --group dev
	touch $@

$(VENV)/.installed-docs: pyproject.toml $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --group docs
	touch $@

clean:
	rm -rf $(VENV) build dist
