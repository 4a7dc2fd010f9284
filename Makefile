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
# torch without CUDA, for Linux without an NVIDIA GPU: a tenth of the download. Where this index is away, PyPI has torch.
TORCH_CPU := https://download.pytorch.org/whl/cpu
STAGES := $(BIN)/python .ci/stages.py

.DEFAULT_GOAL := help
.PHONY: help train check test everything nightly fuzz claims docs gallery tutorials dist install-matrix trainers format clean

help:
	@echo "make train    set up if needed, then train an agent        (ARGS=... go to train.py)"
	@echo "make check    set up if needed, then check format, lint, types, layers, sizes of files and workflows"
	@echo "make test     the same, then the tests that protect a commit: compiled, and kernels as plain Python"
	@echo "                                                           (PYTEST_ARGS=... go to pytest)"
	@echo "make everything    install what the tests that make test skipped need, as far as this machine can, and run them"
	@echo "make nightly  everything else, up to two hours: all tests with many examples, soak and kills, fuzz, claims,"
	@echo "              mutants, coverage, sdist, install-matrix; goes on after a failure, logs in build/nightly"
	@echo "make fuzz     set up if needed, then feed it broken files, command lines and random episodes"
	@echo "make claims   set up if needed, then test every claim of the papers (DATA=folder of recordings)"
	@echo "make docs     set up if needed, then build the site to build/site"
	@echo "make gallery  set up if needed, then draw the films, the previews and the interactive page in docs/ again"
	@echo "make tutorials    set up if needed, then run the tutorials and draw their pictures again"
	@echo "make dist     set up if needed, then build and check wheels for Linux (x86_64, aarch64) and sdist in dist/"
	@echo "make install-matrix    install the wheel for each Python, with the newest and oldest dependencies"
	@echo "make trainers    set up if needed, then run each program of examples/trainers in a fresh environment (LIBRARY=skrl: one)"
	@echo "make format   set up if needed, then format and fix what can be fixed"
	@echo "make clean    remove caches and build products; keeps .venv and results"
	@echo ""
	@echo "Set-up makes .venv with PYTHON=$(PYTHON), and is repeated when pyproject.toml or constraints.txt change."

train: $(READY)
	$(BIN)/python train.py $(ARGS)

# The tiers. What each one runs stands in .ci/stages.py.
check: $(READY)
	$(STAGES) check

test: $(READY)
	$(STAGES) test $(PYTEST_ARGS)

everything: $(READY)
	$(STAGES) everything $(PYTEST_ARGS)

nightly: $(READY)
	$(STAGES) nightly $(PYTEST_ARGS)

# Broken files, command lines and random episodes: others every day.
fuzz: $(READY)
	HYPOTHESIS_PROFILE=nightly $(PYTEST) tests/fuzz $(PYTEST_ARGS)

# Every figure, and which verdicts differ from those on the page.
claims: $(READY)
	mkdir -p build
	$(BIN)/python -m bufgym reproduce --claims build/claims.md $(if $(DATA),--data $(DATA))
	$(BIN)/python .ci/claims.py results/claims.md build/claims.md

docs: $(READY)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet --strict
	@echo "build/site/index.html"

gallery: $(READY)
	$(BIN)/python -m website.films all --interactive docs/interactive.html
	$(BIN)/python -m website.previews

# Each draws its picture beside itself.
tutorials: $(READY)
	for page in docs/tutorials/*.py; do \
	  (cd docs/tutorials && ../../$(BIN)/python $$(basename $$page)) || exit 1; done
	rm -rf docs/tutorials/*.csv docs/tutorials/mine

# The first builds the sdist, and its wheel from that. zig compiles both wheels, for a libc from 2012 on.
dist: $(READY)
	rm -rf dist
	$(PIP) install --quiet -c constraints.txt -e ".[dist]"
	BUFGYM_TARGET=x86_64-linux $(BIN)/python -m build --outdir dist .
	BUFGYM_TARGET=aarch64-linux $(BIN)/python -m build --wheel --outdir dist .
	for folder in packages/*; do $(BIN)/python -m build --outdir dist $$folder || exit 1; done
	$(BIN)/python -m twine check --strict dist/*

# Every Python that is here, each with the newest dependencies and with the oldest that pyproject allows.
install-matrix: dist
	.ci/install-matrix

trainers: $(READY)
	.ci/trainers $(LIBRARY)

format: $(READY)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

clean:
	rm -rf build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find bufgym packages agents studies tests -name __pycache__ -prune -exec rm -rf {} +

# Byte code is made when a module is first imported: making it for all takes half the time of an installation.
$(READY): pyproject.toml $(wildcard packages/*/pyproject.toml) constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
	  echo "bufgym needs Python 3.11 or newer; '$(PYTHON)' is $$($(PYTHON) --version 2>&1 || true)." >&2; \
	  echo "Name another one: make PYTHON=python3.11 ..." >&2; exit 1; }
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv $(VENV)
	@[ "$$(uname)" != Linux ] || nvidia-smi >/dev/null 2>&1 || \
	  $(PIP) install --quiet --no-compile --no-deps --retries 0 --timeout 5 -c constraints.txt --index-url $(TORCH_CPU) torch \
	  >/dev/null 2>&1 || true
	$(PIP) install --quiet --no-compile -c constraints.txt -e ".[dev]" -e "packages/robot[all]" -e "packages/relay[all]" \
	  -e "packages/papers[all]"
	@touch $@
