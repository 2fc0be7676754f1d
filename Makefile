# Everything runs in the project's own virtual environment, made on first use.
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
export OMP_NUM_THREADS ?= 1

.PHONY: demo test lint type format bench clean

# The main job: train DSAC on Pendulum-v1 through RL-Zoo3's own command, then evaluate what was learned
demo: $(INSTALLED)
	$(BIN)/rl_zoo3 train --algo dsac --env Pendulum-v1 --progress --eval-freq 5000 --seed 0 --log-folder logs
	$(BIN)/rl_zoo3 enjoy --algo dsac --env Pendulum-v1 --no-render -n 4000 --folder logs

test: lint type
	$(BIN)/python -m pytest -n 2 --dist loadfile

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

type: $(INSTALLED)
	$(BIN)/mypy

format: $(INSTALLED)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Hours: see benchmarks/README.md
bench: $(INSTALLED)
	$(BIN)/python benchmarks/speed.py
	$(BIN)/python benchmarks/learning.py run --jobs 2
	$(BIN)/python benchmarks/learning.py report
	$(BIN)/python benchmarks/safedrive.py speed
	$(BIN)/python benchmarks/safedrive.py drivers
	$(BIN)/python benchmarks/safedrive.py traffic
	$(BIN)/python benchmarks/safedrive.py takeovers
	$(BIN)/python benchmarks/safedrive.py learn --jobs 2
	$(BIN)/python benchmarks/safedrive.py report
	$(BIN)/python benchmarks/dagger.py --hidden 512

$(INSTALLED): setup.cfg pyproject.toml constraints.txt build_hooks.py sb3_chac.pth sb3_chac.start
	python3 -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[dev]"
	touch $@

clean:
	rm -rf $(VENV) build dist *.egg-info
