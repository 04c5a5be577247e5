# Each target sets up what it needs (dev/setup.sh, once) and then runs one thing.

VENV := $(if $(ROS_DISTRO),.venv-ros,.venv)
PYTEST_ARGS ?=
GOLDEN_ARGS ?=
FUZZ_SECONDS ?= 600
FUZZ_ARGS ?=
BENCH_ARGS ?=
SOAK_DAYS ?= 30
SOAK_HOURS ?= 5
SOAK_MINUTES ?= 60
SOAK_OUT ?= build/soak
# Modules are byte-compiled when they are first imported, and not in each process anew.
unexport PYTHONDONTWRITEBYTECODE

RESOLVE = $(VENV)/bin/uv pip compile --quiet --upgrade --no-annotate --python-version 3.11 \
	--custom-compile-command 'make lock'

# make variable -> option of `pose-graph demo`; only those that are given
option = $(if $($(1)),--$(2) '$($(1))')
DEMO_ARGS = $(call option,BAG,bag) $(call option,ODOM,odom) $(call option,FIX,fix) \
	$(call option,GLOBAL_POSE,global-pose) $(call option,LOOP_CLOSURE,loop-closure) \
	$(call option,TRUTH,truth) $(call option,HOLD_OUT,hold-out) $(call option,RATE,rate) \
	$(call option,OUT,out)

.PHONY: help setup setup-demo setup-test demo test golden coverage fuzz bench soak docs guides lint types fmt \
	lock clean

help:
	@echo 'make demo    set up, then simulate a drive, replay it through the node and judge the result'
	@echo '             own bag: BAG=folder|file.mcap|file.db3 ODOM=/topic FIX=/topic [GLOBAL_POSE=/topic]'
	@echo '             [LOOP_CLOSURE=/topic] [TRUTH=/topic] [HOLD_OUT=5] [RATE=factor] [OUT=demo]'
	@echo 'make test    set up, then run the checks (ruff, mypy) and all tests; PYTEST_ARGS="-k word"'
	@echo 'make coverage    which lines of the engine its own tests run'
	@echo 'make golden  make the figures of test/golden anew; GOLDEN_ARGS="--check --exact" compares'
	@echo 'make fuzz    try odd inputs on all that reads, and odd histories; FUZZ_SECONDS=600 each'
	@echo 'make bench   measure the engine against GTSAM; BENCH_ARGS="--quick --gate", or --help'
	@echo 'make soak    a month through the engine and an hour through the node: hours, at low priority;'
	@echo '             [SOAK_DAYS=30] [SOAK_HOURS=5 a day] [SOAK_MINUTES=60] [SOAK_OUT=build/soak]'
	@echo 'make guides  run all commands of docs/guides/ for the tools: minutes'
	@echo 'make docs    the pages of docs/ as a site: build/docs/index.html'
	@echo 'make lint    ruff alone;  make types: mypy alone;  make fmt: let ruff mend what it can'
	@echo 'make setup   set up alone: $(VENV), from wheels, or on top of ROS where one is sourced;'
	@echo '             compiles the solver'
	@echo 'make lock    resolve dev/requirements*.in again into requirements*.lock'
	@echo 'make clean   remove the set-up and what builds leave behind'
	@echo 'PYTHON=python3.12 chooses the Python of the set-up.'

setup:
	@dev/setup.sh

setup-demo:
	@dev/setup.sh $(if $(BAG),,--demo)

setup-test:
	@dev/setup.sh --test

demo: setup-demo
	@$(VENV)/bin/pose-graph demo $(DEMO_ARGS)

test: setup-test
	@dev/test.sh $(VENV) $(PYTEST_ARGS)

# of the engine by its own tests: to trace those of the node and the tools takes as long as they do
coverage: setup-test
	$(VENV)/bin/python -m coverage erase
	$(VENV)/bin/python -m coverage run -m pytest -q -n 3 --dist loadfile test/core
	$(VENV)/bin/python -m coverage combine --quiet
	$(VENV)/bin/python -m coverage report --skip-covered --sort=cover --include='pose_graph_ros/core/*'

golden: setup-test
	@$(VENV)/bin/python test/golden $(GOLDEN_ARGS)

fuzz: setup-test
	@$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check --no-deps \
		-r test/fuzz/requirements.txt
	@$(VENV)/bin/python test/fuzz --seconds $(FUZZ_SECONDS) $(FUZZ_ARGS)

bench: setup
	@$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check --no-deps \
		-r benchmark/requirements.txt
	@$(VENV)/bin/python -m benchmark $(BENCH_ARGS)

soak: setup
	@nice $(VENV)/bin/python -m benchmark.soak engine --days $(SOAK_DAYS) --hours $(SOAK_HOURS) \
		-o $(SOAK_OUT)
	@nice $(VENV)/bin/python -m benchmark.soak node --minutes $(SOAK_MINUTES) -o $(SOAK_OUT)
	@$(VENV)/bin/python -m benchmark.soak page -o $(SOAK_OUT)

guides: setup-test
	@POSE_GRAPH_GUIDES=1 $(VENV)/bin/python -m pytest -q --timeout 1500 test/test_guides.py

# in an environment of its own: the site needs nothing of the package, and no ROS
docs: .venv-docs/bin/sphinx-build
	@$< --quiet --fail-on-warning --keep-going -c docs -d build/docs_trees . build/docs
	@echo 'build/docs/index.html'

.venv-docs/bin/sphinx-build: docs/requirements.txt
	@$(or $(PYTHON),python3) -m venv --clear .venv-docs
	@.venv-docs/bin/python -m pip install --quiet --disable-pip-version-check --no-deps -r $<
	@touch $@

lint: setup-test
	$(VENV)/bin/ruff check

types: setup-test
	$(VENV)/bin/mypy

fmt: setup-test
	$(VENV)/bin/ruff check --fix

# for the oldest supported Python: what is the newest for 3.11 also exists for 3.12
lock: setup
	$(RESOLVE) dev/requirements.in -o requirements.lock
	$(RESOLVE) dev/requirements.in dev/requirements-test.in -c requirements.lock \
		| grep -vxF -f requirements.lock \
		| sed '1i # What tests and checks need beside requirements.lock; made by `make lock`.' \
		>requirements-test.lock
	$(RESOLVE) dev/requirements-docs.in -o docs/requirements.txt

clean:
	rm -rf .venv .venv-ros .venv-docs build install log *.egg-info .coverage htmlcov
	rm -rf .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find pose_graph_ros test launch -name __pycache__ -prune -exec rm -rf {} +
