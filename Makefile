# Two commands matter: `make demo` and `make test`. Both set everything up in .venv first.

PYTHON ?= python3
VENV   ?= .venv
DEMO    = demo
BIN     = $(VENV)/bin
STAMP   = $(VENV)/.installed
TEST_STAMP = $(VENV)/.installed-test
INSTALL = PIP_CONSTRAINT=constraints.txt $(BIN)/python -m pip install --quiet --disable-pip-version-check
SOURCES = $(shell find src/vdgs/kernels/native src/vdgs/kernels/shared -name "*.h" -o -name "*.cpp") CMakeLists.txt pyproject.toml constraints.txt

# Make and the shell would take its parts for folders of their own, and `make clean` remove each.
ifneq ($(words $(VENV)),1)
$(error VENV="$(VENV)" is empty or holds blanks: name a folder without them, or make a virtual environment there by hand and `pip install .` into it)
endif

# Threads of torch and numpy block instead of spinning beside the kernels' own.
export OMP_WAIT_POLICY = PASSIVE
export OPENBLAS_NUM_THREADS = 1
# What one process of the tests has compiled, the others find.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help setup setup-test demo test test-fast lint types clean

help:
	@echo "make demo    generate a small town, run the whole method on it, report (a few minutes, no GPU)"
	@echo "make test    lint, types and the whole test suite"
	@echo "make test-fast  the tests that are marked neither slow nor browser (two minutes)"
	@echo "make setup   only install into $(VENV); make setup-test: with what the tests need"
	@echo "make clean   remove $(VENV), build/ and $(DEMO)/"

setup: $(STAMP)

$(BIN)/python:
	$(PYTHON) -c 'import sys; sys.exit("vdgs needs Python 3.11 or newer, found " + sys.version.split()[0] if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(VENV)

# PIP_CONSTRAINT also pins the tools that pip installs only for building.
$(STAMP): $(BIN)/python $(SOURCES)
	@echo "installing vdgs into $(VENV) and compiling its kernels: some minutes"
	$(INSTALL) -e '.[demo,viewer]'
	@touch $(STAMP)

# The tests need more: linters, Ray, readers of what is exported.
$(TEST_STAMP): $(STAMP)
	@echo "installing what the tests need"
	$(INSTALL) -e '.[test]'
	@touch $(TEST_STAMP)

setup-test: $(TEST_STAMP)

# Fewer steps than the preset takes, so that it ends in minutes.
demo: setup
	rm -rf $(DEMO)
	$(BIN)/vdgs synth $(DEMO)/capture
	$(BIN)/vdgs inspect $(DEMO)/capture --output $(DEMO)/inspect
	$(BIN)/vdgs run $(DEMO)/capture --output $(DEMO)/run --preset laptop --blocks 4 --iterations 1600 --block.iterations 420
	$(BIN)/vdgs export $(DEMO)/run --output $(DEMO)/run/scene.html --color-iterations 1
	@echo
	@echo "test views:  $(DEMO)/run/evaluation/contact_sheet.png"
	@echo "metrics:     $(DEMO)/run/evaluation/metrics.json"
	@echo "map:         $(DEMO)/run/maps/orthophoto.png"
	@echo "model:       $(DEMO)/run/merged/model.safetensors (vdgs export $(DEMO)/run --output scene.ply for other programs)"
	@echo "open this:   $(DEMO)/run/report.html (offline: the place, its map and figures, and a link into the scene)"

lint: setup-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: setup-test
	$(BIN)/mypy

test: lint types
	$(BIN)/python -m pytest

test-fast: setup-test
	$(BIN)/python -m pytest -m "not slow and not browser"

clean:
	rm -rf $(VENV) build $(DEMO)
