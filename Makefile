# Everything starts here, on a machine with nothing but Python 3 and make:
#   make train        a robot learns from images; the preset follows the hardware
# uv is fetched into .uv/ where it is missing, and everything else goes into .venv/.

SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DELETE_ON_ERROR:

SEED ?= 0
PRESET ?= auto
RUN_DIR ?= runs/seed$(SEED)-$(shell date +%Y%m%d-%H%M%S)
ARGS ?=
RESULTS ?=
# One more than the cores of a small machine, because some tests wait.
WORKERS ?= 3
EXAMPLES ?= 2000
FUZZED := tests/readers/test_readers.py tests/readers/test_readers_of_runs.py tests/readers/test_reader_bounds.py tests/readers/test_mathematical_properties.py
PYTHON ?= >=3.11,<3.14

# Evaluated once: `:=` would run them for `make help` too, so each sits in the recipe that needs it.
UV = $$(uv --version >/dev/null 2>&1 && echo uv || echo .uv/bin/uv)
PINS = $(UV) pip compile --universal --python-version 3.11 --generate-hashes --no-emit-index-url --no-emit-find-links \
	--quiet --custom-compile-command "make pins"
BIN := .venv/bin
STAMPS := .venv/stamps
ACCELERATOR := $(shell nvidia-smi -L >/dev/null 2>&1 && echo gpu || echo base)

.PHONY: help train test test-all fuzz docs page page-check lint format bench-cpu tables stale verify-release pins clean
.DEFAULT_GOAL := help

help: ## Show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-14s %s\n", $$1, $$2}' Makefile
	@echo
	@echo "  variables: SEED=$(SEED) PRESET=$(PRESET) (auto: cpu or fast by the hardware) RUN_DIR=... ARGS='--any-option 1' WORKERS=$(WORKERS)"

train: $(STAMPS)/$(ACCELERATOR) ## Train on VisualFetchReach; curve.png and video.gif land in RUN_DIR
	@$(BIN)/jaxrl-vis train --preset $(PRESET) --seed $(SEED) --run-dir "$(RUN_DIR)" $(ARGS)

test: $(STAMPS)/dev ## Run the tests, except slow ones
	@$(BIN)/python -m pytest -n $(WORKERS) -m "not slow" $(ARGS)

test-all: $(STAMPS)/dev ## Run all tests
	@$(BIN)/python -m pytest -n $(WORKERS) $(ARGS)

fuzz: $(STAMPS)/dev ## Try EXAMPLES=2000 corrupted files of each kind on their readers, other ones each time
	@EXAMPLES=$(EXAMPLES) $(BIN)/python -m pytest -q -rP --hypothesis-profile=fuzz $(FUZZED) $(ARGS)

docs: $(STAMPS)/docs ## Build the documentation's site into build/site/
	@NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet
	@echo "open build/site/index.html"

page: $(STAMPS)/dev ## What the site's page that plays needs, into build/play/; needs npm. Then make docs
	@JAX_PLATFORMS=cpu $(BIN)/python docs/tools/browser_page.py

page-check: page docs ## Compare that page with renderer, policy and physics, in headless Chromium
	@$(BIN)/python docs/tools/browser_check.py

lint: $(STAMPS)/dev ## Check style, format and types
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/pyright

format: $(STAMPS)/dev ## Mend style and format
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

bench-cpu: $(STAMPS)/base ## Run the five benchmarks at CPU sizes; records land in your cache, or in RESULTS=folder
	@for benchmark in render physics env update train; do \
		JAX_PLATFORMS=cpu $(BIN)/jaxrl-vis bench $$benchmark $(if $(RESULTS),--results "$(RESULTS)") $(ARGS); done

tables: $(STAMPS)/dev ## Write the tables of README and docs from the records in benchmarks/results
	@JAX_PLATFORMS=cpu $(BIN)/python -m benchmarks.ledger tables

stale: $(STAMPS)/dev ## List records that are older than the code they measured, and rows without a record
	@JAX_PLATFORMS=cpu $(BIN)/python -m benchmarks.ledger stale

verify-release: $(STAMPS)/dev ## Build wheel and sdist twice, compare, install and try the wheel in an empty environment; into dist/
	@$(BIN)/python -m benchmarks.verify_release $(ARGS)

pins: .venv/bin/python ## Write requirements/*.txt anew
	@$(PINS) $(PINS_ARGS) pyproject.toml -c requirements/cpu.in -o requirements/base.txt
	@$(PINS) $(PINS_ARGS) pyproject.toml --group dev -o requirements/dev.txt
	@$(PINS) $(PINS_ARGS) --group docs -c requirements/dev.txt -o requirements/docs.txt
	@$(PINS) $(PINS_ARGS) pyproject.toml --extra cuda12 -c requirements/dev.txt -o requirements/gpu.txt
	@if grep -E -n '://|--(extra-)?(index-url|find-links)' requirements/*.txt; then echo "pins must carry no address" >&2; exit 1; fi

clean: ## Remove what make built (not runs/)
	rm -rf .venv .uv build dist .pytest_cache .ruff_cache

# A private environment works where pip refuses to touch the system's ("externally managed"); --target works where the
# system's Python has pip but no venv.
.uv/bin/uv:
	@echo "uv is missing: installing it into .uv/"
	@if ! python3 -m venv .uv 2>/dev/null || ! .uv/bin/python -m pip install --quiet uv; then \
		rm -rf .uv; python3 -m pip install --quiet --target .uv uv; fi

.venv/bin/python:
	@uv --version >/dev/null 2>&1 || $(MAKE) --no-print-directory .uv/bin/uv
	@$(UV) venv --quiet --python "$(PYTHON)" .venv

# dev holds all of gpu but CUDA, at the same versions, so that either may follow the other. base has an older JAX
# (requirements/cpu.in), which dev gives way to where there is no GPU.
# Installation compiles bytecode, but not for dev, most of whose packages no test imports.
INSTALL = $(UV) pip install --quiet $(if $(filter-out dev,$*),--compile-bytecode) --python .venv --require-hashes
$(STAMPS)/dev: requirements/base.txt
$(STAMPS)/%: requirements/%.txt pyproject.toml | .venv/bin/python
	@echo "installing requirements/$*.txt into .venv/"
	@$(INSTALL) -r requirements/$*.txt
	@$(if $(filter dev-base,$*-$(ACCELERATOR)),$(INSTALL) -r requirements/base.txt)
	@$(UV) pip install --quiet --python .venv --no-deps -e .
	@mkdir -p $(STAMPS) && touch $@
