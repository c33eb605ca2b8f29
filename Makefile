# Everything runs from .venv, which make builds itself from the locked versions in requirements.lock.
PYTHON ?= $(firstword $(shell command -v python3.11 python3.12 python3.13 python3))
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# What `make accelerator` may take, all in all.
MINUTES ?= 10
TABLE_SYSTEMS := v2 mvp v1 v2-row-major v1-wo-proj v1-1stage v1-g-emb v1-gv-emb ftl-meshtr pe-meshtr v1-wo-pt
# Two workers: most of the suite is compiling, which keeps one core busy each.
PYTEST := $(BIN)/python -m pytest -n 2
# The files with tests of a marker: to collect all others takes a third of a minute a worker.
files_with = $(sort $(shell grep -rlw --include="test_*.py" "mark\.$(1)" tests))

.PHONY: setup demo test test-browser test-parity test-slow lint bench accelerator synthetic-table lock clean
.DEFAULT_GOAL := help

help:
	@echo "make setup   build .venv from the locked versions"
	@echo "make demo    reconstruct both hands of the four bundled videos into out/demo"
	@echo "make test    the default test suite (a quarter to half an hour on 2 cores)"
	@echo "make lint    ruff and pyright"
	@echo "make bench   print the speed tables of benchmarks/"
	@echo "make synthetic-table   train the systems of the synthetic table: 22 runs, 14 h at the lowest priority"
	@echo "make accelerator MINUTES=10   measure a GPU, then train the shipped model on"

setup: $(STAMP)

$(STAMP): pyproject.toml requirements.lock
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet -r requirements.lock
	$(BIN)/python -m pip install --quiet --no-deps --editable .
	@touch $@

demo: setup
	$(BIN)/poem demo --out out/demo

test: setup
	$(PYTEST)

test-browser: setup
	@command -v chromium >/dev/null || { apt-get update -qq && apt-get install -y -qq chromium >/dev/null; }
	$(BIN)/python -m pytest -m browser

# Programs are compiled here as users' are; in the other suites LLVM optimises nothing.
test-parity: setup
	XLA_FLAGS=--xla_force_host_platform_device_count=2 $(PYTEST) -m parity --dist loadfile --no-loadscope-reorder $(call files_with,parity)

test-slow: setup
	$(PYTEST) -m slow -rs --dist worksteal $(call files_with,slow)

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

bench: setup
	@for script in benchmarks/*.py; do echo "== $$script"; $(BIN)/python $$script || exit 1; done

accelerator: setup
	$(BIN)/python -m tools.accelerator --minutes $(MINUTES)

# Every system twice; what was stopped goes on where it was, what is exported stays. Then the table of them.
synthetic-table: setup
	@for seed in 0 1; do for system in $(TABLE_SYSTEMS); do \
	  model=checkpoints/synthetic_table/$$system-$$seed; [ -d $$model ] && continue; \
	  run="nice -n 19 $(BIN)/poem train synthetic_table:$$system --train.seed $$seed \
	    --train.out runs/synthetic_table_$$system-$$seed"; \
	  $$run && $$run --export $$model || exit 1; done; done
	nice -n 19 $(BIN)/python eval.py --table synthetic

lock: setup
	$(BIN)/pip-compile --quiet --strip-extras --no-emit-options --no-emit-index-url --no-emit-find-links --extra dev --extra train --output-file requirements.lock pyproject.toml

clean:
	rm -rf $(VENV) out
