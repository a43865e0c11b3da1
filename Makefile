# Two commands: `make run` and `make test`. Both make .venv first; a second call reinstalls nothing.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
REQUIREMENTS := $(if $(LOCKED),requirements.lock,requirements.txt)
INSTALLED := $(VENV)/.installed$(if $(LOCKED),-locked)

# What a .venv whose Python is gone, as after an upgrade of the system, had installed is to be installed again.
$(shell test -x $(BIN)/python || rm -f $(VENV)/.installed*)

CHECK_PYTHON := import sys; sys.version_info >= (3, 10) or sys.exit('error: Python ' + sys.version.split()[0] + \
	' is too old, 3.10 or newer is needed; name one, such as: make run PYTHON=python3.12')

# pip leaves compiling to the first import. With this variable set, every process would compile torch
# again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: run quick cluster calibration test test-fast test-mujoco test-oldest lint typecheck bench results soak lock clean

# Two processes of one thread each; a test file stays in one of them, so that its fixtures are made once.
# tests/conftest.py orders the files.
PARALLEL := -n 2 --dist loadfile --no-loadscope-reorder
test test-fast test-oldest: export OMP_NUM_THREADS := 1

run: $(INSTALLED)
	$(BIN)/python evaluate.py $(ARGS)

# The whole chain in five minutes: a little data, a short training, a scored network.
quick: $(INSTALLED)
	mkdir -p runs
	$(BIN)/python train_graspnet.py --config configs/quick.yaml --weights runs/quick.pt
	$(BIN)/python evaluate.py --config configs/quick.yaml

# A Dask scheduler and WORKERS workers on this machine, for compute.scheduler=tcp://127.0.0.1:8786 (docs/scaling.md).
WORKERS ?= $(shell getconf _NPROCESSORS_ONLN)
cluster: export PYTHONPATH := $(CURDIR)
cluster: export OMP_NUM_THREADS := 1
cluster: export DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED := False
cluster: $(VENV)/.installed-cluster
	$(BIN)/dask scheduler --host 127.0.0.1 --port 8786 & trap "kill $$! 2>/dev/null" EXIT INT TERM; \
	echo "in another terminal: .venv/bin/python evaluate.py compute.scheduler=tcp://127.0.0.1:8786 (Ctrl-C here ends the cluster)"; \
	$(BIN)/dask worker tcp://127.0.0.1:8786 --nworkers $(WORKERS) --nthreads 1

# The chances of success of all planners, fitted again to executed grasps: half an hour or more on two cores.
# The runs' names are their time and just this: a run called my-calibration is none of them.
STAMP := [0-9]*-[0-9][0-9][0-9][0-9][0-9][0-9]
calibration: $(INSTALLED)
	$(BIN)/python evaluate.py --config configs/calibration.yaml
	$(BIN)/python evaluate.py --config configs/calibration_household.yaml
	$(BIN)/python evaluate.py --config configs/calibration_rounded.yaml
	$(BIN)/python evaluate.py --config configs/calibration_flat.yaml
	$(BIN)/python -m benchmarks.calibrate $$(ls -d runs/evaluate/$(STAMP)-calibration | tail -1) \
		$$(ls -d runs/evaluate/$(STAMP)-calibration-household | tail -1) \
		$$(ls -d runs/evaluate/$(STAMP)-calibration-rounded | tail -1) \
		$$(ls -d runs/evaluate/$(STAMP)-calibration-flat | tail -1) --output checkpoints/calibration.json

test: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -q $(PARALLEL) --durations=10 $(ARGS)

test-fast: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -q $(PARALLEL) -m "not slow" $(ARGS)

# The fast suite as where PyBullet has no wheel, in a virtual environment of its own.
test-mujoco:
	$(MAKE) .venv-mujoco/.installed-dev VENV=.venv-mujoco
	.venv-mujoco/bin/python -m pip uninstall --yes pybullet panda-gym
	$(MAKE) test-fast VENV=.venv-mujoco

# The fast suite with the oldest versions that requirements*.txt admit.
test-oldest: $(VENV)/.installed-dev
	$(BIN)/uv venv --allow-existing --python $(BIN)/python .venv-oldest
	$(BIN)/uv pip install --python .venv-oldest --resolution lowest-direct -r requirements.txt -r requirements-dev.txt
	.venv-oldest/bin/python -m pytest -q $(PARALLEL) -m "not slow" $(ARGS)

# Style, and who imports whom (pyproject.toml, tests/test_layers.py).
lint: $(VENV)/.installed-dev
	$(BIN)/ruff check . && $(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-cache --no-logo
	$(BIN)/python -m pytest -q tests/test_layers.py

# Types of the public modules that pyproject.toml lists.
typecheck: $(VENV)/.installed-dev
	$(BIN)/mypy

bench: $(VENV)/.installed-dev
	$(BIN)/python -m benchmarks.bench_env $(ARGS)

# Every table of README and docs/results.md: make results PARTS=scoreboard,servo. With SCALE below 1 other
# scenes are played and no docs written, but with WRITE=1: make results PARTS=clutter15 SCALE=0.5 WRITE=1
results: $(VENV)/.installed-dev
	$(BIN)/python -m benchmarks.results $(if $(PARTS),--parts $(PARTS)) $(if $(SCALE),--scale $(SCALE)) $(if $(WRITE),--write-docs) $(if $(CORNELL),--cornell "$(CORNELL)") $(if $(YCB),--ycb "$(YCB)") $(if $(CLUTTER),--clutter "$(CLUTTER)") $(ARGS)

# Faults by the thousand: make soak PARTS=files,disk SCALE=0.1; writes docs/reliability.md.
soak: $(VENV)/.installed-dev
	$(BIN)/python -m benchmarks.soak --json docs/results/reliability.json $(if $(PARTS),--parts $(PARTS)) $(if $(SCALE),--scale $(SCALE)) $(ARGS); \
	status=$$?; $(BIN)/python -m benchmarks.results --write && exit $$status

$(VENV)/bin/python:
	@$(PYTHON) -c "$(CHECK_PYTHON)" && { $(PYTHON) -m venv --clear $(VENV) || { rm -rf $(VENV); exit 1; }; }

# The pip of Python 3.10.13 tries versions for more than ten minutes; the newest one does not.
# Without compiling all of torch to bytecode, pip needs half the time.
# LOCKED=1 takes the versions and hashes of requirements.lock, as CI does; they include what tests need.
$(INSTALLED): $(REQUIREMENTS) | $(VENV)/bin/python
	-$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --no-compile -r $(REQUIREMENTS)
	touch $@

$(VENV)/.installed-cluster: $(INSTALLED)
	$(BIN)/python -m pip install "distributed>=2025.1"
	touch $@

$(VENV)/.installed-dev: requirements-dev.txt $(INSTALLED)
	$(BIN)/python -m pip install --no-compile -r requirements-dev.txt
	touch $@

# The newest versions that requirements*.txt admit, with hashes for every system and Python: requirements.lock.
lock: $(VENV)/.installed-dev
	$(BIN)/uv pip compile --quiet --universal --python-version 3.10 --upgrade --generate-hashes --no-annotate \
		--custom-compile-command "make lock" --output-file requirements.lock requirements.txt requirements-dev.txt

clean:
	rm -rf .venv .venv-mujoco .venv-oldest
