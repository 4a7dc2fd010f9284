# Two commands do everything on a fresh machine with Python >= 3.11, git and make: `make train` and `make test`.

PYTHON ?= python3
ARGS ?=
PYTEST_ARGS ?=

VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
PIP := $(BIN)/python -m pip --disable-pip-version-check --no-input
# Two workers side by side, each with one thread: more only make them wait for one another.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2

.DEFAULT_GOAL := help
.PHONY: help train test fuzz claims docs gallery tutorials dist install-matrix format clean

help:
	@echo "make train    set up if needed, then train an agent        (ARGS=... go to train.py)"
	@echo "make test     set up if needed, then check everything      (PYTEST_ARGS=... go to pytest)"
	@echo "make fuzz     set up if needed, then feed it broken files, command lines and random episodes (nightly)"
	@echo "make claims   set up if needed, then test every claim of the papers (nightly; DATA=folder of recordings)"
	@echo "make docs     set up if needed, then build the site to build/site"
	@echo "make gallery  set up if needed, then draw the films and the interactive page in docs/ again"
	@echo "make tutorials    set up if needed, then run the tutorials and draw their pictures again"
	@echo "make dist     set up if needed, then build and check wheel and sdist in dist/"
	@echo "make install-matrix    install the wheel for each Python, with the newest and oldest dependencies (nightly)"
	@echo "make format   set up if needed, then format and fix what can be fixed"
	@echo "make clean    remove caches and build products; keeps .venv and results"
	@echo ""
	@echo "Set-up makes .venv with PYTHON=$(PYTHON), and is repeated when pyproject.toml or constraints.txt change."

train: $(READY)
	$(BIN)/python train.py $(ARGS)

# Format, lint, types; then the tests compiled, and once more as plain Python.
test: $(READY)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	NUMBA_DISABLE_JIT=0 $(PYTEST) $(PYTEST_ARGS)
	NUMBA_DISABLE_JIT=1 $(PYTEST) -m "not slow" $(PYTEST_ARGS)

# For the night: 100,000 broken files of each kind, 10,000 command lines, 1,000,000 episodes, 200 kills, others every day.
fuzz: $(READY)
	BUFGYM_FUZZ=100000 BUFGYM_FUZZ_SEED=$$(date +%Y%m%d) HYPOTHESIS_PROFILE=nightly $(PYTEST) tests/fuzz $(PYTEST_ARGS)

# For the night: every figure, and what came out beside the page as it stands.
claims: $(READY)
	mkdir -p build
	$(BIN)/python -m bufgym reproduce --claims build/claims.md $(if $(DATA),--data $(DATA))
	diff docs/claims.md build/claims.md

docs: $(READY)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet --strict
	@echo "build/site/index.html"

gallery: $(READY)
	$(BIN)/bufgym gallery all --out docs/gallery --interactive docs/interactive.html

# Each draws its picture beside itself.
tutorials: $(READY)
	for page in docs/tutorials/*.py; do \
	  (cd docs/tutorials && ../../$(BIN)/python $$(basename $$page)) || exit 1; done
	rm -rf docs/tutorials/*.csv docs/tutorials/mine

dist: $(READY)
	rm -rf dist
	$(PIP) install --quiet -c constraints.txt -e ".[dist]"
	$(BIN)/python -m build
	$(BIN)/python -m twine check --strict dist/*

# For the night: every Python that is here, each with the newest dependencies and with the oldest that pyproject allows.
install-matrix: dist
	.ci/install-matrix

format: $(READY)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

clean:
	rm -rf build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find bufgym agents tests -name __pycache__ -prune -exec rm -rf {} +

$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
	  echo "bufgym needs Python 3.11 or newer; '$(PYTHON)' is $$($(PYTHON) --version 2>&1 || true)." >&2; \
	  echo "Name another one: make PYTHON=python3.11 ..." >&2; exit 1; }
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv $(VENV)
	$(PIP) install --quiet -c constraints.txt -e ".[dev]"
	@touch $@
