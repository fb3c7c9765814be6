# `make help` lists these commands. All but help and clean first make the virtual environment .venv.
# Another Python: make PYTHON=python3.12 train
# Other settings: make train ARGS="env=corridor sampler=per"

PYTHON ?= python3
PIP_FLAGS ?=
ARGS ?= env=maze sampler=aser
BIN := .venv/bin

.DEFAULT_GOAL := help
.PHONY: help install train test trust lint sweep figures reproduce claims page explorer same bench soak clean

help: ## list these commands
	@sed -nE 's/^([a-z]+):.*## (.*)/  make \1\t\2/p' $(MAKEFILE_LIST) | expand -t 18

install: .venv/installed ## make .venv and install the project with its development tools

.venv/installed: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' || \
		(echo "Python 3.11, 3.12 or 3.13 is needed: make PYTHON=python3.11 ..." >&2; exit 1)
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install $(PIP_FLAGS) --quiet --editable '.[dev]'
	touch $@

train: .venv/installed ## train 16 seeds of ASER in the maze (a minute or two), or ARGS="..."
	$(BIN)/python -m train $(ARGS)

test: .venv/installed ## run the quick tests
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadgroup

trust: .venv/installed ## run the slow tests: fuzz, kills, clusters, all figures (over an hour)
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m slow tests -n 2 --dist loadgroup

lint: .venv/installed ## check the code with ruff and mypy
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

sweep: .venv/installed ## tune what is not tuned yet (hours), or ARGS="env=maze sampler=aser"
	OMP_NUM_THREADS=1 PYTHONPATH=.$${PYTHONPATH:+:$$PYTHONPATH} $(BIN)/python scripts/sweep.py $(if $(filter file,$(origin ARGS)),all,$(ARGS))

# COMMIT=1 lets these three write the committed results in place of your own.
FIGURES := $(BIN)/python scripts/figures.py $(if $(filter 1,$(COMMIT)),--commit)

figures: .venv/installed ## draw all figures, without training, into results/own, or FIGURE=fig05
	PYTHONPATH=.$${PYTHONPATH:+:$$PYTHONPATH} $(FIGURES) draw $(FIGURE)

reproduce: .venv/installed ## train what figures lack, draw them in results/own, or FIGURE=fig05
	OMP_NUM_THREADS=1 PYTHONPATH=.$${PYTHONPATH:+:$$PYTHONPATH} $(FIGURES) reproduce $(FIGURE)

claims: .venv/installed ## decide the claims by what you have reproduced (results/own/claims.md)
	PYTHONPATH=.$${PYTHONPATH:+:$$PYTHONPATH} $(FIGURES) claims

page: .venv/installed ## write the page of results, results/site/index.html
	$(BIN)/python scripts/page.py

explorer: .venv/installed ## record the runs of the page's maze explorer again (ten minutes)
	OMP_NUM_THREADS=1 $(BIN)/python scripts/explore.py

same: .venv/installed ## compare small runs at REV=<commit> and here, bit for bit
	$(BIN)/python scripts/same.py $(REV)

bench: .venv/installed ## measure the speed (an hour), or parts: ARGS="peers steps"
	$(BIN)/python -c "import rejax, sbx, stable_baselines3" 2>/dev/null || $(BIN)/python -m pip install $(PIP_FLAGS) --quiet --editable '.[bench]'
	$(BIN)/python benchmarks/measure.py $(filter-out env=% sampler=%,$(ARGS))

soak: .venv/installed ## train each sampler for a million steps, watching memory and speed (hours)
	$(BIN)/python benchmarks/soak.py

clean: ## remove .venv and all caches, but no results
	rm -rf .venv build .pytest_cache .mypy_cache .ruff_cache .hypothesis src/*.egg-info
	find src tests -name __pycache__ -type d -prune -exec rm -rf {} +
