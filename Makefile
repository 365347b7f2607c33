# Everything a user or CI needs: `make demo`, `make test`. Both set up what is missing.
SHELL := /bin/bash
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STORE ?= .extrags/demo
# Actively waiting OpenMP threads slow each other down on machines with few cores.
export OMP_WAIT_POLICY := passive

# Processes of one thread each: most tests are too small for more. One more than cores: that of the flows waits
# for its server a good part of the time.
PARALLEL := --numprocesses $(shell expr $$(nproc) + 1) --dist loadgroup

.PHONY: help setup system demo test test-slow lint same-results bench clean

help: ## Show this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/' | sort

setup: .stamps/installed ## System libraries, virtual environment, native kernels

system:
	@bash .ci/system-libraries

.stamps/venv: requirements.lock
	@$(MAKE) --no-print-directory system
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --requirement requirements.lock
	@mkdir -p .stamps && touch $@

NATIVE := $(wildcard CMakeLists.txt extrags/raster/kernels/*)
.stamps/installed: .stamps/venv pyproject.toml $(NATIVE)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps \
		--no-build-isolation --editable .
	@touch $@

# Weights of LPIPS, for its figure in the demo; empty where there are none.
EXTRAGS_LPIPS_WEIGHTS ?= $(abspath $(wildcard ../shared/data/lpips_weights))
demo: export EXTRAGS_LPIPS_WEIGHTS := $(EXTRAGS_LPIPS_WEIGHTS)
demo: setup ## Reconstruct, explore, restore and evaluate the phantom, both settings
	$(BIN)/extrags run phantom/0@sparse phantom/0@distanced --profile quick --store $(STORE)

# Tests start many programs, each of which would compile the project anew.
test test-slow: export PYTHONDONTWRITEBYTECODE :=
# Arrays that a test has freed serve the next one, instead of being given back and zeroed anew: 6 % less time.
test test-slow: export MALLOC_MMAP_THRESHOLD_ := 1000000000
test test-slow: export MALLOC_TRIM_THRESHOLD_ := 1000000000
test test-slow: export MALLOC_TOP_PAD_ := 67108864

test: setup ## The default test suite
	$(BIN)/python -m pytest $(PARALLEL)

test-slow: setup ## The default suite and everything marked slow
	$(BIN)/python -m pytest $(PARALLEL) --runslow

lint: setup ## Format, lint, types, import layers, spelling
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	@# Elsewhere jaxtyping shapes look like undefined names, and mypy knows better.
	$(BIN)/ruff check --quiet --select F821 tests
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/codespell

same-results: setup ## Update the stage inventory after a change of version, or of code with equal results
	$(BIN)/python -m tests.stage_inventory

bench: setup ## Benchmarks of the kernels (JSON on standard output)
	$(BIN)/extrags bench raster --json -
	$(BIN)/extrags bench train --json -

clean: ## Remove build products, not the artefact store
	rm -rf build dist .stamps .pytest_cache .mypy_cache .ruff_cache
