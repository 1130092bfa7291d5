# Two commands do everything on a fresh machine: `make table1` and `make test`. Each sets itself up.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
MODELS := 3dgs,4dgs,6dgs,7dgs,7dgs_noagr,auto
# More overrides: make table1 ARGS="train.iterations=3000 seed=1"
ARGS ?=
# What this machine measures. What we published is in results/published/, and only --against and its own path read it.
RESULTS ?= results

# The CUDA kernels, compiled for five architectures, take minutes: made where a GPU is to run them. CUDA=on|auto|off.
CUDA := $(if $(shell nvidia-smi -L 2> /dev/null),auto,off)

# The instruction sets that the kernels are built for: native, this machine's best, or all, which takes twice as long.
LEVELS ?= native

# What builds images.
DOCKER ?= docker

.PHONY: help table1 frontier tables test test-all notebooks stability stability-long bench gpu-check slurm-check sanitize lint format docs scenes setup locks wheel image clean
.DEFAULT_GOAL := help

help:  ## what there is to make
	@grep -hE '^[a-z0-9-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

setup: $(VENV)/levels-$(LEVELS)  ## make .venv and install gsbench into it, with pinned versions whose hashes are checked

# locks/ has all that comes along, so pip resolves nothing and fetches no tools to build with; a file with another hash
# is refused.
PIP := $(BIN)/pip install --quiet --disable-pip-version-check --no-compile --no-deps --no-build-isolation --use-pep517
LOCKED := $(PIP) --require-hashes --requirement locks

# Beside the kernels, which take as long to compile: unpacked on one core, their bytecode written on all (pip has one).
TORCH := $(LOCKED)/torch.txt
ifeq ($(CUDA),off)
TORCH := { $(LOCKED)/torch_cpu.txt || { echo "no torch for the CPU at hand (docs/install.md): PyPI's, several GB on Linux"; $(TORCH); }; }
endif
LIBRARIES := $(TORCH) && $(LOCKED)/tests.txt && { $(BIN)/python -m compileall -qq -j 0 $(VENV)/lib || :; }

# Installed again whenever what is installed changes: the metadata, the pins, the native sources.
NATIVE := CMakeLists.txt $(shell find gsbench/kernels -name '*.cpp' -o -name '*.h' -o -name '*.cu')
$(VENV)/levels-%: pyproject.toml $(wildcard locks/*.txt) $(NATIVE)
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' || \
		{ echo "gsbench needs Python 3.11, 3.12 or 3.13; $(PYTHON) is $$($(PYTHON) --version). Try make PYTHON=python3.12"; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(LOCKED)/build.txt
	$(PIP) --config-settings cmake.define.CUDA=$(CUDA) --config-settings cmake.define.GSB_LEVELS=$* --editable . & \
		kernels=$$!; $(LIBRARIES); status=$$?; wait $$kernels && exit $$status
	@$(BIN)/python -c 'import sys; from gsbench import kernels; sys.exit(not kernels.available())' || \
		echo "gsbench is installed without its kernels, and slow: docs/install.md says what they need"
	rm -f $(VENV)/levels-*
	touch $@ $(if $(filter all,$*),$(VENV)/levels-native)

# Sphinx and the kernel of notebooks: for those who ask for the site or for all tests.
$(VENV)/installed-docs: $(VENV)/levels-$(LEVELS)
	$(LOCKED)/docs.txt
	touch $@

# Two runs at once, each with half of the cores: small runs leave a second thread idle for part of a step. Exit status 1 of
# the report: numbers that differ from the published ones, which it says, and which are a result.
table1: setup  ## train 3DGS, 4DGS, 6DGS and 7DGS with and without AGR, and model=auto, on the embedded scenes; print the table, compare it
	@status=0; \
	$(BIN)/python -m gsbench --multirun +exp=mini +launch=parallel launch.at_once=2 results=$(RESULTS) model=$(MODELS) $(ARGS) \
		|| status=$$?; \
	$(BIN)/python -m gsbench.report $(RESULTS)/mini --against results/published/mini || [ $$? -eq 1 ] || status=2; \
	exit $$status

# Models come last, so that they take turns: minutes in which the machine is slow are every model's.
frontier: setup  ## train seven models at five lengths and two capacities, and AGR on all, three seeds, two at a time; 54 minutes
	@status=0; for axis in train.iterations=250,500,1000,2000,4000 train.densify.grad_threshold=4e-4; do \
		$(BIN)/python -m gsbench --multirun +exp=frontier +launch=parallel launch.at_once=2 \
			results=$(RESULTS) seed=0,1,2 $$axis model=$(MODELS),7dgs_nodir $(ARGS) || status=$$?; \
	done; \
	$(BIN)/python -m gsbench --multirun +exp=frontier +launch=parallel launch.at_once=2 \
		results=$(RESULTS) seed=0,1,2 model=3dgs,4dgs,6dgs,7dgs_nodir agr=true $(ARGS) || status=$$?; \
	$(BIN)/python -m gsbench.report $(RESULTS)/frontier || status=$$?; \
	exit $$status

tables: setup  ## write Tables 1 and 2 of the paper, and one of its successors and rivals, from whatever is in results/, and say what is missing
	$(BIN)/python -m gsbench.report --tables $(RESULTS)

# Two processes, for CI has two cores; a file's tests stay together, since they share trainings. In the order
# of tests/conftest.py: xdist would begin with the files of most tests, which are not the longest.
test: lint  ## lint, types and all tests but the slow ones
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

test-all: $(VENV)/levels-all lint $(VENV)/installed-docs  ## the slow tests too, in every instruction set
	$(BIN)/python -m pytest -m 'slow or not slow'

notebooks: $(VENV)/installed-docs  ## run the notebooks of examples/ from a fresh folder
	$(BIN)/python -m pytest -n 0 -m slow tests/test_examples.py

stability: $(VENV)/levels-all  ## hard cases against an oracle; results/stability/, fails where a default breaks its bound
	PYTHONPATH=tests $(BIN)/python -m numerics $(ARGS)

stability-long: $(VENV)/levels-all  ## the same with long trainings, and 10,000 random hard cases from slice to gradient
	PYTHONPATH=tests $(BIN)/python -m numerics --long
	$(BIN)/python -m pytest tests/numerics tests/raster/test_exact.py -m slow

bench: $(VENV)/levels-all  ## time every stage and kernel against the machine's limits; ARGS="--against COMMIT" too; results/benchmarks/
	$(BIN)/python -m benchmarks $(ARGS)

gpu-check:  ## on a machine with a GPU, offline: build, test, train, sanitize and time the CUDA kernels; results/benchmarks/
	$(PYTHON) benchmarks/gpu_check.py $(ARGS)

slurm-check: setup  ## as root, with Slurm from Debian's packages: sweep on a real Slurm, break it, compare with this machine's numbers
	PYTHONPATH=tests $(BIN)/python tests/slurm/check.py $(ARGS)

sanitize: setup  ## build the kernels with the address and undefined-behaviour sanitizers and run their tests
	tests/kernels/sanitize.sh $(BIN)/python

lint: setup  ## ruff and mypy
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: setup  ## let ruff rewrite the code
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: $(VENV)/installed-docs  ## build the site from docs/ into build/site
	$(BIN)/python docs/site/tables.py
	$(BIN)/python -m sphinx -q -E -W --keep-going -b html -d build/doctrees docs build/site
	@echo "open build/site/index.html"

# Blender has a .venv of its own, for it needs Python 3.11 and an older numpy.
scenes:  ## render the embedded scenes anew into build/scenes, with Blender (Python 3.11, 1 GB); half an hour
	$(PYTHON) -m venv build/blender
	build/blender/bin/pip install --quiet --disable-pip-version-check --no-deps --require-hashes --requirement locks/blender.txt
	for scene in moving-matte pendulum suzanne; do \
		build/blender/bin/python tools/generate_scenes.py $$scene build/scenes/$$scene || exit; \
	done

locks:  ## resolve locks/ anew, after a change of pyproject.toml or constraints.txt; asks PyPI
	$(PYTHON) -m venv build/uv
	build/uv/bin/pip install --quiet --disable-pip-version-check --no-deps --require-hashes --requirement locks/uv.txt
	build/uv/bin/python locks/write.py

wheel: setup  ## build a wheel with the kernels of every instruction set into dist/
	$(BIN)/pip wheel --quiet --disable-pip-version-check --no-deps --no-build-isolation --wheel-dir dist \
		--config-settings build-dir=build/wheel --config-settings cmake.define.CUDA=$(CUDA) .

image: wheel  ## build an image of that wheel by Docker, Podman or Buildah: DOCKER=podman; docs/install.md
	$(DOCKER) build --file containers/Dockerfile --tag gsbench \
		$(if $(filter off,$(CUDA)),,--build-arg TORCH_INDEX=) $(ARGS) .

clean:  ## remove what was built and installed; results stay
	rm -rf $(VENV) build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
