# Everything starts here. `tools/uv` is uv, installed on first use.
UV := ./tools/uv
DEV := $(UV) run --group dev

.PHONY: help train test test-slow test-gpu-script test-mujoco-next check format bench reference gpu \
	torture packages docs

help:  ## Show this list.
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

# TORCH names a build of torch that is not the default: that without CUDA on Linux.
train:  ## Train the cartpole swing-up on this machine's CPU; on Linux without a GPU: make train TORCH=cpu.
	@test -z "$(TORCH)" || $(UV) run -q --no-project --python '>=3.11,<3.15' tools/torch_wheel.py $(TORCH)
	$(UV) run mjlab train Mjlab-Cartpole-Swingup --profile cpu --device cpu --result-video True

test:  ## Run the test suite.
	$(DEV) pytest -n 2 -m "not slow and not robustness" tests

test-slow:  ## Run the tests that take long.
	$(DEV) pytest -m slow tests

test-gpu-script:  ## Run every part of `make gpu` at tiny sizes, without a GPU.
	$(DEV) pytest -m slow tests/benchmarks/test_gpu.py

# MuJoCo 4 is `mujoco-core` and a viewer. Other dependencies are those that the project resolves to.
# The project's constraints name the release that it pins, so its configuration is left out.
NEXT := $(CURDIR)/.venv-next
test-mujoco-next:  ## Run tests/sim on MuJoCo 4.0.1 and MuJoCo Warp 4.0.0, in an environment apart.
	$(UV) venv -q --allow-existing --python 3.11 $(NEXT)
	$(UV) export -q --group dev --no-hashes --no-emit-project --no-emit-package mujoco \
		--no-emit-package mujoco-warp > $(NEXT)/pinned.txt
	$(UV) pip install -q --no-config --python $(NEXT) --no-deps -r $(NEXT)/pinned.txt \
		mujoco-core==4.0.1 mujoco-warp==4.0.0 -e .
	$(NEXT)/bin/python -m pytest -n 2 -m "not slow" tests/sim

check:  ## Check format, lint, types and import layers.
	$(DEV) ruff format --check .
	$(DEV) ruff check .
	$(DEV) ruff check --preview --select PLW1514 src  # Text files are UTF-8 on every platform.
	$(DEV) ty check
	$(DEV) lint-imports

format:  ## Format the code and fix what lint can fix.
	$(DEV) ruff format .
	$(DEV) ruff check --fix .

bench:  ## Measure; writes the table to benchmarks/results/. BEFORE=../checkout to compare with.
	$(DEV) python benchmarks/run.py $(if $(BEFORE),--before $(BEFORE))

# DEVICE has a default below, which is not meant here.
reference:  ## Train stock tasks on several seeds; TASKS="A B" SEEDS=N MINUTES=N AGAIN=1 DEVICE=cpu limit it.
	$(DEV) python benchmarks/reference.py $(if $(TASKS),--tasks $(TASKS)) $(if $(SEEDS),--seeds $(SEEDS)) \
		$(if $(MINUTES),--minutes $(MINUTES)) $(if $(AGAIN),--again) \
		$(if $(filter command environment,$(origin DEVICE)),--device $(DEVICE))

# No network and no uv: any Python with the dependencies, that of the project where there is one.
PYTHON ?= $(or $(wildcard .venv/bin/python),python3)
DEVICE ?= cuda:0

gpu:  ## Measure and test on an NVIDIA GPU, in twelve minutes; PARTS="parity speed" for some parts.
	status=0; \
	$(PYTHON) benchmarks/gpu.py --device $(DEVICE) $(if $(PARTS),--part $(PARTS)) $(GPU_FLAGS) || status=1; \
	$(if $(PARTS),,MJLAB_TEST_CUDA_DEVICE=$(DEVICE) $(PYTHON) -m pytest -q -m cuda tests/sim || status=1;) \
	exit $$status

torture:  ## Kill, damage, limit, mistake and attack; PARTS="kills page" SEED=N MINUTES=N TRIAL=N.
	$(DEV) pytest -s -m robustness tests/robustness $(if $(PARTS),--parts $(PARTS)) \
		$(if $(SEED),--seed $(SEED)) $(if $(MINUTES),--minutes $(MINUTES)) $(if $(TRIAL),--trial $(TRIAL)) \
		$(TORTURE_FLAGS)

packages:  ## Try task packages: make packages DIRS="../a ../b"; without DIRS, those of the tests.
	$(DEV) python tools/packages.py $(DIRS) $(if $(ENGINES),--engines $(ENGINES))

docs:  ## Build the documentation into docs/_build/html.
	$(UV) run --group docs sphinx-build -W --keep-going -b html docs docs/_build/html
