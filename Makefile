# `make demo` and `make test` each work as the first command on a fresh machine.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Numba keeps compiled kernels here between runs.
export NUMBA_CACHE_DIR ?= $(CURDIR)/.numba_cache

.PHONY: demo test test-slow lint types check bench clean clean-cache

$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --disable-pip-version-check --quiet --constraint constraints.txt --editable '.[demo,dev]'
	# It asks for torchvision, of which a test needs one layer and brings its own.
	$(BIN)/pip install --disable-pip-version-check --quiet --constraint constraints.txt --no-deps pytorchcv
	touch $@

demo: $(VENV)/.installed
	$(BIN)/spackle demo --output demo-output

test: $(VENV)/.installed
	$(BIN)/python -m pytest

test-slow: $(VENV)/.installed
	$(BIN)/python -m pytest -m slow || test $$? -eq 5  # 5: nothing is marked

lint: $(VENV)/.installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.installed
	$(BIN)/mypy

check: lint types test

bench: $(VENV)/.installed
	$(BIN)/python benchmarks/render_cpu.py
	$(BIN)/python benchmarks/ply.py

clean-cache:
	rm -rf .numba_cache
	find src -name '*.nb[ci]' -delete

clean:
	rm -rf $(VENV) .numba_cache demo-output build
