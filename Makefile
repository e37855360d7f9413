# The commands a newcomer types.
# OMP_WAIT_POLICY=PASSIVE: on shared cores waiting threads that spin made two threads twenty times slower than one.
export OMP_WAIT_POLICY = PASSIVE
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
PIP = $(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check -c constraints.txt
OUT ?= runs/demo
PYTEST_FLAGS ?=

.PHONY: demo demo-quick test suite lint types types-js reference docs wheel try-wheel clean
.DEFAULT_GOAL := demo

## the whole pipeline on the synthetic scenarios, to runs/demo/report.html
demo: $(BIN)/.installed
	$(BIN)/rlftsim demo --out $(OUT)

## the same stages at their smallest
demo-quick: $(BIN)/.installed
	$(BIN)/rlftsim demo --quick --out $(OUT)-quick

## lint, types and tests; pyright, which has one core busy, beside the tests
test: lint
	$(MAKE) --no-print-directory -j 2 suite types

suite: $(BIN)/.installed-test
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder --jaxtyping-packages=rlftsim,beartype.beartype $(PYTEST_FLAGS)

lint: $(BIN)/.installed-test
	$(BIN)/ruff check src tests benchmarks docs
	$(BIN)/ruff format --check src tests benchmarks docs

# pip would compile all of every package in one process, which takes half of the installation; the demo imports a part
$(BIN)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(PIP) -e .
	PYTHONDONTWRITEBYTECODE= $(BIN)/python -c "import rlftsim.experiments.demo"
	touch $@

$(BIN)/.installed-test: $(BIN)/.installed
	$(PIP) -e ".[test,docs,wheel]"
	$(BIN)/python -m compileall -qq -j 0 $(VENV)/lib || true  # some packages hold templates that are no Python
	touch $@

## static types; pyright and the node that runs it come as wheels
types: $(BIN)/.installed-test
	$(BIN)/pyright --pythonpath $(BIN)/python src

## types of the studio's JavaScript, from its JSDoc
types-js:
	npx --yes --package typescript@7 tsc --project tests/studio/jsconfig.json

## the reference alone, in build/pages/reference
reference: $(BIN)/.installed-test
	$(BIN)/python docs/write_reference.py

## the site, in build/site: opens from disk, needs no server
docs: $(BIN)/.installed-test
	$(BIN)/python docs/build_site.py

## the wheel and the sdist, in dist/: two builds of a commit are the same bytes
wheel: $(BIN)/.installed-test
	rm -rf dist
	SOURCE_DATE_EPOCH=$$(git log -1 --format=%ct) $(BIN)/python -m hatchling build
	$(BIN)/twine check --strict dist/*
	$(BIN)/check-wheel-contents dist/*.whl
	sha256sum dist/*

## the wheel in an environment of its own: make try-wheel PYTHON=python3.12
try-wheel: wheel
	$(PYTHON) -m venv --clear dist/venv
	dist/venv/bin/pip install --quiet -c constraints.txt dist/*.whl
	$(BIN)/python tests/try_installed.py $(CURDIR)/dist/venv/bin/python

clean:
	rm -rf $(VENV) runs
