# Everything a newcomer needs: `make demo`, `make test`. Python 3.11 and make are enough.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
GROUP ?=

.PHONY: setup demo test test-all check format bench wheel clean

setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[dev]"
	touch $@

demo: setup  ## simulate, record, render again, measure: out/demo/
	$(BIN)/h3data demo -o out/demo --force

test: setup
	$(BIN)/python -m pytest -n 2

test-all: setup  ## the slow ones too
	$(BIN)/python -m pytest -n 2 -m "not gpu and not bench"

check: setup  ## format, lint, types, layers
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright
	$(BIN)/lint-imports

format: setup
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

bench: setup  ## all benchmarks, or GROUP=render
	$(BIN)/python -m benchmarks $(GROUP)

wheel: setup
	$(BIN)/python -m build --no-isolation

clean:
	rm -rf $(VENV) out dist build
