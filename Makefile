# Everything runs in the project's own virtual environment, made on first use.
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
DEMO := logs/demo
DEMO_RUN := $(DEMO)/chac/SafeDrive-v0_1
export OMP_NUM_THREADS ?= 1

.PHONY: demo test test-slow lint type format docs bench clean

# The main job: train C-HAC on SafeDrive with the scripted driver as the human, through RL-Zoo3's own command; evaluate what was
# learned on maps that it has not seen, beside the human-guided policy alone and the human; draw the curves and film a drive.
# Seven and a half minutes on two cores of an AMD EPYC. The tables of the logger are in progress.csv (--verbose 0), the progress bar tells the rest.
demo: $(INSTALLED)
	rm -rf $(DEMO)
	$(BIN)/rl_zoo3 train --algo chac --env SafeDrive-v0 -n 15000 -params switch_after:8000 prefit_steps:2000 \
		--eval-freq 3000 --eval-episodes 10 --seed 0 --progress --verbose 0 --log-interval 1 --log-folder $(DEMO)
	$(BIN)/sb3-chac evaluate $(DEMO_RUN)/SafeDrive-v0.zip --scenarios 1000:1020 --beside guided scripted \
		--json $(DEMO)/evaluation.json --plot $(DEMO)/paths.png --video $(DEMO)/drive.mp4
	$(BIN)/sb3-chac plot $(DEMO_RUN) --out $(DEMO)/curves.png
	@echo "Everything is in $(DEMO): curves.png, drive.mp4, paths.png, evaluation.json; the model is in $(DEMO_RUN)"

test: lint type
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "not slow"

# What `make test` leaves out: installing everything anew, SB3's whole test suite, long soaks
test-slow: $(INSTALLED)
	$(BIN)/python -m pytest -n 2 --dist worksteal -m slow

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

type: $(INSTALLED)
	$(BIN)/mypy

format: $(INSTALLED)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# The documentation, warnings being errors: docs/_build/html/index.html, static files that any web server can serve
docs: $(INSTALLED)
	$(BIN)/sphinx-build --fail-on-warning --keep-going --quiet -b html docs docs/_build/html

# Every benchmark, quick ones first. Days in all: most do only what is missing, so stop it at any time. Not here, as it needs an
# environment of its own: `parity.py d3rlpy`. See benchmarks/README.md
bench: $(INSTALLED)
	$(BIN)/python benchmarks/speed.py
	$(BIN)/python benchmarks/safedrive.py speed
	$(BIN)/python benchmarks/safedrive.py traffic
	$(BIN)/python benchmarks/safedrive.py takeovers
	$(BIN)/python benchmarks/safedrive.py drivers
	$(BIN)/python benchmarks/dagger.py --hidden 512
	$(BIN)/python benchmarks/sb3_suite.py
	$(BIN)/python benchmarks/refusals.py
	$(BIN)/python benchmarks/chaos.py
	for part in export latency link cuts report; do $(BIN)/python benchmarks/deploy.py $$part || exit; done
	for part in drive "drive --env MetaDriveSafety-v0" browser report; do $(BIN)/python benchmarks/cockpit.py $$part || exit; done
	for part in data ours report; do $(BIN)/python benchmarks/parity.py $$part || exit; done
	$(BIN)/python benchmarks/confidence.py run benchmarks/agents/chac-SafeDrive-v0.zip
	$(BIN)/python benchmarks/confidence.py report
	for part in train test report; do $(BIN)/python benchmarks/roadtest.py $$part || exit; done
	for part in "drivers --jobs 2" report; do $(BIN)/python benchmarks/metadrive_safety.py $$part || exit; done
	for part in "learn --jobs 2" report; do $(BIN)/python benchmarks/safedrive.py $$part || exit; done
	for part in "rounds --jobs 2" "gail --jobs 2" report; do $(BIN)/python benchmarks/imitation.py $$part || exit; done
	for part in "run --jobs 2" report; do $(BIN)/python benchmarks/learning.py $$part || exit; done
	for part in "run --jobs 2" report; do $(BIN)/python benchmarks/lagrangian.py $$part || exit; done
	for part in "run --jobs 2" report agents cost; do $(BIN)/python benchmarks/guidance.py $$part || exit; done
	for part in "run --jobs 2" report; do $(BIN)/python benchmarks/beyond.py $$part || exit; done
	$(BIN)/python benchmarks/foresight.py benchmarks/models/SafeDrive-v0/chac-stage-1-*.zip
	for part in "run --jobs 2" report; do $(BIN)/python benchmarks/suite.py $$part || exit; done
	$(BIN)/python benchmarks/film.py
	$(BIN)/python benchmarks/tables.py

$(INSTALLED): setup.cfg pyproject.toml constraints.txt build_hooks.py sb3_chac.pth sb3_chac.start
	python3 -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[dev]"
	touch $@

clean:
	rm -rf $(VENV) build dist *.egg-info
