# laneweave: `make demo` and `make test` on a fresh machine need Python >= 3.11 and make.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed
RUN    ?= runs/demo
BUDGET ?= 90

# An idle worker takes over half of another worker's remaining tests.
PYTEST := $(BIN)/pytest -n 2 --dist worksteal

# Linear algebra stays on one thread: many processes share few cores.
export OMP_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1

.PHONY: demo test test-unit test-full evaluation evaluation-faults docs check format clean install help

help: ## list the targets
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 19

install: $(STAMP) ## make .venv and install laneweave with everything

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "laneweave needs Python >= 3.11: make PYTHON=python3.11 ...")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt hatchling editables
	$(BIN)/pip install --quiet --disable-pip-version-check --no-build-isolation -c constraints.txt -e '.[dev]'
	find coordinator -name '*.nb[ci]' -delete
	$(BIN)/python -c 'from laneweave.coordinator.planning import warm_up; warm_up()'
	touch $@

demo: $(STAMP) ## let vehicles sort themselves on the paper's road, one process per vehicle
	rm -rf $(RUN)
	$(BIN)/laneweave run scenarios/demo.toml --out $(RUN)

check: $(STAMP) ## format, lint, types, import contracts
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(STAMP) ## rewrite the code in the project's format
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

test-unit: $(STAMP) ## the inner loop: no processes, under a minute
	$(PYTEST) -m 'not full and not slow' tests/unit

test: $(STAMP) ## what CI runs
	$(PYTEST) -m 'not full'

test-full: $(STAMP) ## the long programmes too
	$(PYTEST)

evaluation: $(STAMP) ## run what docs/EVALUATION.md reports and write its tables (BUDGET=90 minutes on 2 cores)
	$(BIN)/python benchmarks/evaluate.py --budget $(BUDGET)

evaluation-faults: $(STAMP) ## the same for "Under faults": apart, since it takes an hour and a half
	$(BIN)/python benchmarks/evaluate.py --only faults

docs: $(STAMP) ## write the generated parts of the documents
	$(BIN)/python docs/generate.py

clean: ## remove everything that was made
	rm -rf $(VENV) runs build dist .mypy_cache .ruff_cache .pytest_cache .import_linter_cache
