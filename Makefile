# On a fresh machine `make demo` and `make test` need Python >= 3.11 and make.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed
RUN    ?= runs/demo
BUDGET ?= 90

# Tests of real processes mostly wait, so three workers use two cores better than two, and four need
# more CPU time. Each worker collects all tests (9 s of CPU time). An idle worker takes over half of
# another worker's remaining tests.
PYTEST := $(BIN)/pytest -n 3 --dist worksteal

# One thread for linear algebra: many processes share few cores.
export OMP_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1
# Keep compiled modules: every process of a run would otherwise compile the project again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test test-more test-unit test-full containers evaluation evaluation-faults docs site check format clean install help

help: ## list the targets
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 19

install: $(STAMP) ## create .venv and install laneweave with all extras

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "laneweave needs Python >= 3.11: make PYTHON=python3.11 ...")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt hatchling editables setuptools
	$(BIN)/pip install --quiet --disable-pip-version-check --no-build-isolation -c constraints.txt -e '.[dev]'
	$(BIN)/laneweave compile
	touch $@

demo: $(STAMP) ## run lane sorting on the paper's road, one process per vehicle (WATCH=1: with a live page)
	rm -rf $(RUN)
	$(if $(WATCH),,@echo 'To watch the road in a browser: make demo WATCH=1')
	$(BIN)/laneweave run scenarios/demo.toml --out $(RUN) $(if $(WATCH),--watch)

check: $(STAMP) ## check format, lint, types and import contracts
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(STAMP) ## format the code
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

test-unit: $(STAMP) ## run the fast tests: no processes, under a minute
	$(PYTEST) -m 'not full and not more and not slow' tests/unit

test: $(STAMP) ## run the tests that prove that everything works
	$(PYTEST) -m 'not full and not more'

test-more: $(STAMP) ## run what CI runs beyond them
	$(PYTEST) -m '(more or hypothesis) and not full' --hypothesis-profile all

test-full: $(STAMP) ## run all tests, including the long ones
	$(PYTEST) --hypothesis-profile all

containers: $(STAMP) ## build the images of compose.yaml and run the deployment in containers (needs podman or docker)
	$(BIN)/pytest -m full tests/system/test_containers.py

evaluation: $(STAMP) ## run the evaluation and write the tables of docs/EVALUATION_*.md (BUDGET=90 minutes on 2 cores)
	$(BIN)/python benchmarks/evaluate.py --budget $(BUDGET)

evaluation-faults: $(STAMP) ## run the experiments of "Under faults" in docs/EVALUATION_FAULTS.md (an hour and a half)
	$(BIN)/python benchmarks/evaluate.py --only faults

docs: $(STAMP) ## update the generated parts of the documents
	$(BIN)/python docs/generate.py

site: $(STAMP) ## build the website of the documents in build/site
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

clean: ## remove everything that these targets create
	rm -rf $(VENV) runs build dist .mypy_cache .ruff_cache .pytest_cache .import_linter_cache
