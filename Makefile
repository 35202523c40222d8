# Everything runs in an environment of its own, .venv, made on first use and kept until its inputs change.
# Variables: PYTHON (interpreter that makes the environment), ARGS (passed on by reproduce and bench),
#            PYTEST_ARGS (passed on by every pytest run), WORKERS (parallel test processes).

PYTHON      ?= python3
VENV        ?= .venv
ARGS        ?=
PYTEST_ARGS ?=
WORKERS     ?= 2

BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:

.PHONY: help
help: ## List the targets
	@awk -F ':.*## ' '/^[a-z0-9-]+:.*## / { printf "  make %-10s %s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))

# --- environment -----------------------------------------------------------------------------------------------------

ENV_READY := $(VENV)/.stamp-env
APP_READY := $(VENV)/.stamp-app
DEV_READY := $(VENV)/.stamp-dev

$(ENV_READY):
	@command -v "$(PYTHON)" >/dev/null || { \
	  echo "error: '$(PYTHON)' not found. Install Python 3.11 or later, or name one: make PYTHON=/path/to/python3.12 ..." >&2; exit 1; }
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "error: Python 3.11 or later is needed; '$(PYTHON)' is $$("$(PYTHON)" -V 2>&1). Name a newer one: make PYTHON=python3.12 ..." >&2; exit 1; }
	@"$(PYTHON)" -c 'import ensurepip, venv' 2>/dev/null || { \
	  echo "error: '$(PYTHON)' cannot make environments: its venv or ensurepip module is missing. On Debian or Ubuntu: sudo apt install python3-venv" >&2; exit 1; }
	"$(PYTHON)" -m venv --clear "$(VENV)"
	@touch $@

# Editable, so that an edited source file never needs a new installation.
$(APP_READY): $(ENV_READY) pyproject.toml constraints.txt
	$(PIP) install --quiet --constraint constraints.txt --editable '.[app]'
	@touch $@

$(DEV_READY): $(ENV_READY) pyproject.toml constraints.txt
	$(PIP) install --quiet --constraint constraints.txt --editable '.[dev]'
	@touch $(APP_READY) $@

.PHONY: install
install: $(DEV_READY) ## Make the development environment in .venv

# --- use -------------------------------------------------------------------------------------------------------------

.PHONY: reproduce
reproduce: $(APP_READY) ## Run the paper's experiment into results/paper (options: ARGS="...")
	$(BIN)/perfcontrol reproduce --out results/paper $(ARGS)

# --- checks ----------------------------------------------------------------------------------------------------------

.PHONY: test
test: lint types imports docs doctest pytest pytest32 ## Run every check except the slow tests

.PHONY: check
check: lint types imports docs doctest coverage pytest32 slow dist-check oldest newest mutation ## Run every check (hours)

.PHONY: lint
lint: $(DEV_READY) ## Check style and formatting
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

.PHONY: format
format: $(DEV_READY) ## Mend style and formatting where that can be done safely
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

.PHONY: types
types: $(DEV_READY) ## Check types
	$(BIN)/basedpyright --pythonpath $(BIN)/python

.PHONY: imports
imports: $(DEV_READY) ## Check that imports go downward only
	$(BIN)/lint-imports --no-logo

PYTEST   := $(BIN)/python -m pytest
# One file, one worker: what a file compiles is compiled once.
CHECKED  := -n $(WORKERS) --dist loadfile --jaxtyping-packages=perfcontrol,beartype.beartype
# Compiled programs are kept: a second run takes a third of the time of the first.
CACHE    := JAX_COMPILATION_CACHE_DIR=$(CURDIR)/.jax_cache JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS=0 \
            JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES=-1
FLOAT64  := $(CACHE) JAX_ENABLE_X64=1 PERFCONTROL_TEST_X64=1
FLOAT32  := $(CACHE) JAX_ENABLE_X64=0 PERFCONTROL_TEST_X64=0

.PHONY: doctest
doctest: $(DEV_READY) ## Run the examples in the docstrings
	$(FLOAT64) $(PYTEST) --doctest-modules src $(PYTEST_ARGS)

.PHONY: pytest
pytest: $(DEV_READY) ## Run the tests in double precision, with shapes and types checked
	$(FLOAT64) $(PYTEST) $(CHECKED) $(PYTEST_ARGS)

.PHONY: pytest32
pytest32: $(DEV_READY) ## Run the tests marked float32 in single precision
	$(FLOAT32) $(PYTEST) $(CHECKED) -m "float32 and not slow" $(PYTEST_ARGS)

.PHONY: slow
slow: $(DEV_READY) ## Run the tests marked slow
	PERFCONTROL_TEST_OPTIMISED=1 $(FLOAT64) $(PYTEST) $(CHECKED) -m slow $(PYTEST_ARGS)

.PHONY: coverage
coverage: $(DEV_READY) ## Run the tests in double precision; fail where they reach less than 95 % of the lines
	$(FLOAT64) $(PYTEST) $(CHECKED) --cov --cov-report= $(PYTEST_ARGS)
	$(BIN)/coverage report --sort=cover
	@$(BIN)/coverage json -q -o - | $(BIN)/python -c 'import json, sys; t = json.load(sys.stdin)["totals"]; \
	  lines, branches = t["percent_statements_covered"], t["percent_branches_covered"]; \
	  print(f"lines {lines:.2f} %, branches {branches:.2f} %"); sys.exit(lines < 95)'

.PHONY: mutation
mutation: $(DEV_READY) ## Make small faults, one at a time; fail where the tests notice less than 90 % (options: ARGS="...")
	$(CACHE) $(BIN)/python -m benchmarks.mutation --workers $(WORKERS) --least 90 $(ARGS) evaluate solvers perturbations sets

.PHONY: oldest newest
oldest: ## Run the tests with the oldest versions that pyproject.toml allows
	.ci/with-versions "$(PYTHON)" oldest -n $(WORKERS) --dist loadfile $(PYTEST_ARGS)

newest: ## Run the tests with the newest versions there are
	.ci/with-versions "$(PYTHON)" newest -n $(WORKERS) --dist loadfile $(PYTEST_ARGS)

.PHONY: docs
docs: $(DEV_READY) ## Build the documentation into site/, warnings being errors
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

.PHONY: dist
dist: $(DEV_READY) ## Build wheel and source distribution into dist/
	rm -rf dist
	$(BIN)/python -m build --outdir dist

.PHONY: dist-check
dist-check: dist ## Try the wheel in a fresh environment, away from the checkout
	.ci/dist-check "$(PYTHON)"

.PHONY: bench
bench: $(DEV_READY) ## Run the benchmarks (options: ARGS="...")
	$(BIN)/python -m benchmarks $(ARGS)

# --- cleaning --------------------------------------------------------------------------------------------------------

.PHONY: clean
clean: ## Remove caches and built files; keep .venv and results/
	rm -rf build dist site .coverage .jax_cache .pytest_cache .ruff_cache .hypothesis .import_linter_cache
	find src tests benchmarks docs examples -name __pycache__ -type d -prune -exec rm -rf {} + 2>/dev/null || true

.PHONY: distclean
distclean: clean ## Remove .venv as well
	rm -rf "$(VENV)"
