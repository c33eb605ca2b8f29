# Everything runs from .venv, which make builds itself from the locked versions in requirements.lock.
PYTHON ?= $(firstword $(shell command -v python3.11 python3.12 python3.13 python3))
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# What `make accelerator` may take, all in all.
MINUTES ?= 10
TABLE_SYSTEMS := v2 v2-row-major v1 mvp v1-wo-proj v1-1stage v1-g-emb v1-gv-emb pe-meshtr ftl-meshtr v2-apart v1-wo-pt
TABLE_MODELS := $(foreach seed,0 1,$(TABLE_SYSTEMS:%=checkpoints/synthetic_table/%-$(seed)))
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
	@echo "make -j2 synthetic-table   train the systems of the synthetic table: 24 runs, two at a time: 5 to 8 h"
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

# What was stopped goes on where it was. On CPUs a run keeps to one core, and -j2 trains two at a time; on a
# GPU leave -j out.
checkpoints/synthetic_table/%: | setup
	@model='$*'; export XLA_FLAGS="$$XLA_FLAGS --xla_cpu_multi_thread_eigen=false"; \
	run="nice -n 19 $(BIN)/poem train synthetic_table:$${model%-*} --train.seed $${model##*-} \
	  --train.out runs/synthetic_table_$$model"; \
	$$run && $$run --export $@

# Every system twice, then the table of them, where the committed one and its scores are: of those that are
# there, whatever became of the others.
synthetic-table: setup
	-$(MAKE) -k $(TABLE_MODELS)
	nice -n 19 $(BIN)/python eval.py --table synthetic --out docs/tables

lock: setup
	$(BIN)/pip-compile --quiet --strip-extras --no-emit-options --no-emit-index-url --no-emit-find-links --extra dev --extra train --output-file requirements.lock pyproject.toml

clean:
	rm -rf $(VENV) out
