# Everything runs inside .venv, which any target that needs it creates. Python >= 3.11 and make
# are all a machine must have. `make PYTHON=python3.12 test` takes another interpreter.

PYTHON ?= python3
WORKERS ?= 2
MINUTES ?= 60
SEED ?= $(shell date +%s)
VENV := .venv
BIN := $(VENV)/bin
PIP_INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt

.DEFAULT_GOAL := help
.PHONY: help demo test test-fast lint format benchmark fuzz docs clean

help:
	@echo "make demo       the main job: two simulated drives, their report in demo/"
	@echo "make test       lint, types, tests"
	@echo "make test-fast  the core and most commands, some minutes: tests/fast.txt"
	@echo "make lint       ruff and mypy alone"
	@echo "make format     let ruff rewrite what it can"
	@echo "make benchmark  timings against OpenCV and NumPy"
	@echo "make fuzz       damaged files against every loader and command, an hour: MINUTES=5 SEED=1"
	@echo "make docs       the site, in site/: guide, API, notebooks; a warning is an error"
	@echo "make clean      remove .venv and everything that was generated"

demo: $(VENV)/.installed
	$(BIN)/jaxnav demo --out demo
	@echo "for all other commands: . $(VENV)/bin/activate, or $(VENV)/bin/jaxnav --help"

test: lint
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile

test-fast: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile @tests/fast.txt

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(VENV)/.installed-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

benchmark: $(VENV)/.installed-dev
	$(BIN)/python -m pytest benchmarks --benchmark-enable --benchmark-only

# The same SEED makes the same cases; each kind of failure is kept in tests/data/fuzz.
fuzz: $(VENV)/.installed-dev
	$(BIN)/python -m tests.fuzz --minutes $(MINUTES) --seed $(SEED) --workers $(WORKERS)

docs: $(VENV)/.installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

clean:
	rm -rf $(VENV) build dist demo out site .pytest_cache .ruff_cache .mypy_cache .hypothesis .benchmarks
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# A stamp is written when its step has succeeded, so a failed installation is tried again.
$(VENV)/.created:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
	  echo "jaxnav needs Python 3.11 or newer and '$(PYTHON)' is not: try make PYTHON=python3.12" >&2; \
	  exit 1; }
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv --clear $(VENV)
	@touch $@

$(VENV)/.installed: pyproject.toml constraints.txt | $(VENV)/.created
	@echo "installing jaxnav into $(VENV)"
	@$(PIP_INSTALL) -e .
	@touch $@

# The test extras contain all that the demo needs.
$(VENV)/.installed-dev: pyproject.toml constraints.txt | $(VENV)/.created
	@echo "installing jaxnav and its test extras into $(VENV)"
	@$(PIP_INSTALL) -e '.[dev]'
	@touch $(VENV)/.installed $@

$(VENV)/.installed-docs: pyproject.toml constraints.txt | $(VENV)/.created
	@echo "installing jaxnav and what builds its site into $(VENV)"
	@$(PIP_INSTALL) -e '.[docs]'
	@touch $(VENV)/.installed $@
