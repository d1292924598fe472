.DELETE_ON_ERROR:
.PHONY: install demo test pytest lint tutorials docs benchmarks

PYTHON ?= python3
BIN := .venv/bin
DEMO ?= runs/demo-$(shell date +%Y%m%d-%H%M%S)

install: .venv/installed

demo: .venv/installed
	$(BIN)/torchrl-pomdp train linear20 --samples-per-part 6000 --iterations 2 --out $(DEMO)

# Types are checked beside the tests, by one process that takes a minute.
test: .venv/installed
	+$(MAKE) --no-print-directory --jobs 2 lint pytest

# Each worker computes with one thread, as many workers as there are processors.
pytest: .venv/installed
	OMP_NUM_THREADS=1 $(BIN)/pytest --numprocesses auto --dist worksteal

lint: .venv/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# Make the notebooks anew from their scripts, with their outputs.
tutorials: .venv/installed
	$(BIN)/jupytext --to ipynb tutorials/*.py
	$(BIN)/jupyter-execute --inplace tutorials/*.ipynb

# The documentation as HTML in docs/_build/html; warnings are errors, and nothing is fetched.
docs: .venv/installed-docs
	$(BIN)/sphinx-build -W --keep-going -q -b html docs docs/_build/html

benchmarks: .venv/installed
	$(BIN)/python -m benchmarks

.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@

.venv/installed-docs: .venv/installed
	$(BIN)/pip install --quiet --constraint constraints.txt --editable '.[docs]'
	touch $@
