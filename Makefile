# make demo: the simulated two-tank problem, set-up included. make test: the tests of every change.
# make lint: layout, types and imports. make test-all: lint, the slower tests, and the documentation.
# make test-long: the tests that take longest, before a release. make docs: the documentation as a
# site, in build/site. make tutorial, make picture: the outputs in docs/tutorial.md and the picture
# in README.md, made anew.
PYTHON ?= python3
BIN := .venv/bin
RUNS ?= runs
# Many tests wait for processes they started: two workers a core keep the cores busy. A file stays
# with one worker, so that what its tests share is made once.
WORKERS ?= $(shell echo $$((2 * $$(getconf _NPROCESSORS_ONLN))))
PYTEST := $(BIN)/pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder --durations 15

# Threads of BLAS only wait for each other where the workers keep the cores busy.
export OPENBLAS_NUM_THREADS ?= 1

# pytest keeps what it compiles of the tests: eight seconds for each worker.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test test-all test-long lint docs tutorial plants picture format clean

.venv/ready: pyproject.toml
	@echo 'Installing ASIA and its libraries into .venv: about a minute, longer on a slow connection'
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	@touch $@

# Workers read the source behind walls and cannot store what Python compiles of it: 1.5 s each.
.PHONY: compiled
compiled: .venv/ready
	@$(BIN)/python -m compileall -q src

.venv/ready-dev: .venv/ready
	$(BIN)/python -m pip install --quiet --disable-pip-version-check 'pip>=25.1'
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --group dev
	$(BIN)/pyright --version >/dev/null
	@touch $@

demo: compiled
	$(BIN)/asia run two_tanks_sim --experiments 8 --runs $(RUNS)
	@printf '\n%s\n%s\n' 'Type next:  source .venv/bin/activate    (puts the command asia on the PATH)' \
	  '            asia show                    (then: docs/tutorial.md, for your own data)'

test: .venv/ready-dev compiled
	$(PYTEST)

# Many tests wait, so that lint runs beside them; what it says comes after them.
test-all: .venv/ready-dev compiled docs
	@mkdir -p build; $(MAKE) --no-print-directory lint >build/lint.txt 2>&1 & lint=$$!; \
	$(PYTEST) -m 'slow and not long'; tests=$$?; wait $$lint; lint=$$?; cat build/lint.txt; exit $$((tests | lint))

test-long: .venv/ready-docs
	$(PYTEST) -m long

lint: .venv/ready-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

.venv/ready-docs: .venv/ready-dev
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --group docs
	@touch $@

docs: .venv/ready-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

# The outputs that the tutorial shows, from a run of its commands: about ten minutes.
tutorial: .venv/ready
	$(BIN)/python docs/site/tutorial.py

# The table in docs/plants.md.
plants: .venv/ready
	$(BIN)/python docs/site/plants.py

# The picture of README.md, from the measured data.
picture: .venv/ready
	$(BIN)/asia run cascaded_tanks --experiments 15 --runs build/picture
	$(BIN)/asia unseal build/picture/cascaded_tanks-expert-s0 --yes
	cp build/picture/cascaded_tanks-expert-s0/report/test.png docs/img/measured.png

format: .venv/ready-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf .venv build dist
