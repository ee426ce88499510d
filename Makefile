# Everything runs inside .venv, which any target that needs it creates. Python >= 3.11 and make
# are all a machine must have. `make PYTHON=python3.12 test` takes another interpreter.

PYTHON ?= python3
WORKERS ?= 2
MARKS ?= not long
MINUTES ?= 60
SEED ?= $(shell date +%s)
VENV := .venv
BIN := $(VENV)/bin
PIP_INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt
# ROS restarts every Python of its environment once, so it has one of its own.
ROS := .venv-ros
ROS_SOURCES := $(shell find ros/environment ros/jaxnav_msgs -type f)

.DEFAULT_GOAL := help
.PHONY: help demo test test-all test-fast lint format benchmark fuzz docs ros test-ros clean

help:
	@echo "make demo       the main job: two simulated drives, their report in demo/"
	@echo "make test       lint, types, tests, but for those that take longest"
	@echo "make test-all   with those, notebooks and ROS"
	@echo "make test-fast  the core and most commands, some minutes: tests/fast.txt"
	@echo "make lint       ruff and mypy alone"
	@echo "make format     let ruff rewrite what it can"
	@echo "make benchmark  timings against OpenCV and NumPy"
	@echo "make fuzz       damaged files against every loader and command, an hour: MINUTES=5 SEED=1"
	@echo "make docs       the site, in site/: guide, API, notebooks; a warning is an error"
	@echo "make ros        ROS 2 with jaxnav and its messages, in .venv-ros, some minutes"
	@echo "make test-ros   tests against that ROS 2"
	@echo "make clean      remove both environments and everything that was generated"

demo: $(VENV)/.installed
	$(BIN)/jaxnav demo --out demo
	@echo "for all other commands: . $(VENV)/bin/activate, or $(VENV)/bin/jaxnav --help"

test: lint
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile -m "$(MARKS)"

test-all:
	$(MAKE) --no-print-directory test test-ros MARKS=

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

ros: $(ROS)/.installed
	@echo "to enter it: . $(ROS)/bin/activate"
	@echo "ROS talks to the whole network unless told: export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST ROS_DOMAIN_ID=7"

# Where there are no wheels, nothing is tested and nothing has failed.
test-ros:
	@if [ -e $(ROS)/.created ] || lacking=$$($(PYTHON) ros/environment/build.py --wheels 2>&1); then \
	  $(MAKE) --no-print-directory $(ROS)/.installed && $(ROS)/bin/python -m pytest -m "$(MARKS)" tests/real_ros; \
	else echo "tests/real_ros are left out: $$lacking"; fi

clean:
	rm -rf $(VENV) $(ROS) build dist demo out site .pytest_cache .ruff_cache .mypy_cache .hypothesis .benchmarks
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

$(ROS)/.created:
	@$(PYTHON) ros/environment/build.py --check
	@$(PYTHON) -m venv --clear $(ROS)
	@touch $@

$(ROS)/.wheels: ros/environment/requirements.txt ros/environment/constraints.txt pyproject.toml constraints.txt | $(ROS)/.created
	@echo "installing ROS 2 and jaxnav into $(ROS)"
	@$(ROS)/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt \
	  -c ros/environment/constraints.txt -r ros/environment/requirements.txt -e '.[apriltag]'
	@touch $@

$(ROS)/.installed: $(ROS)/.wheels $(ROS_SOURCES)
	@echo "building ROS messages into $(ROS)"
	@$(ROS)/bin/python ros/environment/build.py
	@touch $@
