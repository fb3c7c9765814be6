# The project's commands. `make help` lists them; each makes the virtual environment in .venv first.
# Another Python: make PYTHON=python3.12 train. Other settings: make train ARGS="env=corridor sampler=per".

PYTHON ?= python3
PIP_FLAGS ?=
ARGS ?= env=maze sampler=aser
BIN := .venv/bin

.DEFAULT_GOAL := help
.PHONY: help install train test lint sweep figures reproduce claims same bench clean

help: ## list the commands
	@grep -E '^[a-z]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z]+):.*## (.*)/  make \1\t\2/' | expand -t 18

install: .venv/installed ## make .venv and install the project with its development tools

.venv/installed: pyproject.toml
	$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(not (3, 11) <= v < (3, 14) and "Python 3.11 to 3.13 is needed, this is %d.%d: make PYTHON=python3.11 ..." % v[:2])'
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install $(PIP_FLAGS) --quiet --editable '.[dev]'
	touch $@

train: .venv/installed ## train 16 seeds of ASER in the maze (about two minutes); ARGS="..." for anything else
	$(BIN)/python -m train $(ARGS)

test: .venv/installed ## the quick tests
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadgroup

lint: .venv/installed ## ruff (rules and form) and mypy
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

sweep: .venv/installed ## tune everything that is not tuned yet (hours, resumable); ARGS="env=maze sampler=aser" for one
	OMP_NUM_THREADS=1 $(BIN)/python scripts/sweep.py $(if $(filter command,$(origin ARGS)),$(ARGS),all)

figures: .venv/installed ## draw every figure from the committed tables (under a minute); FIGURE=fig05 for one
	$(BIN)/python scripts/figures.py draw $(FIGURE)

reproduce: .venv/installed ## train what a figure lacks, then draw; FIGURE=fig05 for one (all but the long ones)
	OMP_NUM_THREADS=1 $(BIN)/python scripts/figures.py reproduce $(FIGURE)

claims: .venv/installed ## decide every claim by the committed tables: results/claims.md
	$(BIN)/python scripts/figures.py claims

same: .venv/installed ## did a refactoring change a result? REV=<commit>: small runs there and here, compared bit for bit
	$(BIN)/python scripts/same.py $(REV)

bench: .venv/installed ## measure the speed against Stable Baselines3 and SBX (an hour); ARGS="peers steps" for a part
	$(BIN)/python -m pip install $(PIP_FLAGS) --quiet --editable '.[bench]'
	$(BIN)/python benchmarks/measure.py $(filter-out env=% sampler=%,$(ARGS))

clean: ## remove .venv and every cache; results stay
	rm -rf .venv build .pytest_cache .mypy_cache .ruff_cache .hypothesis src/*.egg-info
	find src tests -name __pycache__ -type d -prune -exec rm -rf {} +
