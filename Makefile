# Every target works on a fresh machine: the first makes .venv and installs.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: install demo docs test test-slow fuzz bench mutants
install: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[dev]"
	touch $(STAMP)

demo: $(STAMP)
	$(BIN)/python examples/demo.py

docs: $(STAMP)
	$(BIN)/mkdocs build --strict
	@echo "open site/index.html; for its search, run $(BIN)/mkdocs serve"

test: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/pytest -n auto --maxprocesses 4 -m "not slow"

test-slow: $(STAMP)
	$(BIN)/pytest -m slow

fuzz: $(STAMP)
	COTAP_FUZZ_EXAMPLES=$(or $(EXAMPLES),1000) $(BIN)/pytest tests/test_hostile.py

bench: $(STAMP)
	mkdir -p runs
	$(BIN)/python -m benchmarks.training --json runs/benchmark.json

mutants: $(STAMP)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[dev,mutants]"
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.mutants $(ARGS)
