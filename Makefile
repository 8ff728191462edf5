# make demo: the simulated two-tank problem, set-up included. make test: all checks. make docs: the
# documentation as a site, in build/site.
PYTHON ?= python3
BIN := .venv/bin
RUNS ?= runs

.PHONY: demo test lint docs format clean

.venv/ready: pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	@touch $@

.venv/ready-dev: .venv/ready
	$(BIN)/python -m pip install --quiet --disable-pip-version-check 'pip>=25.1'
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --group dev
	$(BIN)/pyright --version >/dev/null
	@touch $@

demo: .venv/ready
	$(BIN)/asia run two_tanks_sim --experiments 8 --runs $(RUNS)

test: .venv/ready-dev lint
	$(BIN)/pytest -n auto

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

format: .venv/ready-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf .venv build dist
