# `make demo` and `make test` each work as the first command on a fresh machine.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# The versions of all packages, for every Python and system: CONTRIBUTING.md says how they are renewed.
PINNED := --constraint constraints.txt
PIP := $(BIN)/pip install --disable-pip-version-check --quiet $(PINNED)
.PHONY: demo test test-fast hooks pins fuzz test-cudasim test-wheel test-slow wheel dist test-install docs lint types check release-check bench reproduce viewer clean clean-cache

$(VENV)/.demo: pyproject.toml constraints.txt
	@echo "Installing Spackle and what it needs into $(VENV), once: some minutes, about 400 MB of downloads, and 1.6 GB of disk."
	$(PYTHON) -m venv $(VENV)
	./install_torch.sh $(PIP)
	$(PIP) --editable '.[demo]'
	touch $@

# pytorchcv asks for torchvision, of which a test needs one layer and brings its own.
$(VENV)/.installed: $(VENV)/.demo
	$(PIP) --editable '.[demo,dev]'
	$(PIP) --no-deps pytorchcv
	touch $@

demo: $(VENV)/.demo
	@# 0.7 MB, for the table's column "distance".
	$(BIN)/spackle weights get squeezenet || echo "Without it, the table has no distances. The demo goes on."
	$(BIN)/spackle demo --output demo-output

test: $(VENV)/.installed
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

# What a minute can tell: all tests of values, kernels and files, without commands, browsers and training.
test-fast: $(VENV)/.installed
	$(BIN)/python -m pytest -n 2 --dist loadfile -m 'not slow and not journey'

# Checks before each commit (.pre-commit-config.yaml).
hooks: $(VENV)/.installed
	$(BIN)/pre-commit install

# Newer versions of all packages into constraints.txt.
pins: $(VENV)/.installed
	test -x build/uv/bin/uv || { $(PYTHON) -m venv build/uv && build/uv/bin/pip install --quiet uv; }
	build/uv/bin/uv pip compile pyproject.toml --universal --python-version 3.10 --upgrade --quiet \
		$(foreach extra,demo dev eval exr hf opencv train,--extra $(extra)) \
		--no-emit-index-url --no-annotate --no-header --output-file constraints.txt

# In an environment that is empty but for the wheel: pip fetches what it asks for.
test-wheel: $(VENV)/.installed
	SPACKLE_EMPTY=1 $(BIN)/python -m pytest tests/test_quick_start.py tests/test_container.py

wheel: $(VENV)/.demo
	rm -rf dist
	$(BIN)/pip wheel --quiet --no-deps --wheel-dir dist .

# Wheel and sdist as they are published, checked, by tools in an environment of their own.
dist:
	rm -rf dist
	test -x build/publish/bin/twine || { $(PYTHON) -m venv build/publish && \
		build/publish/bin/pip install --quiet --disable-pip-version-check build twine; }
	build/publish/bin/python -m build --quiet
	build/publish/bin/twine check --strict dist/*

# The wheel of `make dist` in an environment that holds nothing else.
test-install:
	rm -rf build/empty
	$(PYTHON) -m venv build/empty
	./install_torch.sh build/empty/bin/pip install --disable-pip-version-check --quiet $(PINNED)
	build/empty/bin/pip install --disable-pip-version-check --quiet $(PINNED) dist/*.whl
	cd build/empty && bin/python -c "import spackle; [getattr(spackle, name) for name in spackle.__all__]"
	cd build/empty && bin/spackle --version

# Damaged files for every reader, N of each; what fails is written to fuzz-failures/, which --replay takes.
N ?= 5000
fuzz: $(VENV)/.installed
	$(BIN)/python tests/fuzz/fuzz.py -n $(N)

test-slow: $(VENV)/.installed
	$(BIN)/python -m pytest -m slow tests research/lite/tests research/worlds/tests

# What runs on a GPU, in numba's simulator; `test` runs it, too.
test-cudasim: $(VENV)/.installed
	NUMBA_ENABLE_CUDASIM=1 $(BIN)/python -m pytest -n 0 tests/test_simulated_gpu.py

lint: $(VENV)/.installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.installed
	$(BIN)/mypy

check: lint types test

# All that can run on one machine before a tag.
release-check: check docs dist test-install reproduce
	@echo "This may be released: see CONTRIBUTING.md for the tag."

bench: $(VENV)/.installed
	$(BIN)/python benchmarks/suite.py --only renderer,video -o bench-suite

# The paper's whole experiment in miniature: tables, figures and a report.
reproduce: $(VENV)/.installed
	rm -rf reproduction
	$(BIN)/python benchmarks/reproduce.py -o reproduction

# The documentation as a site: build/site/index.html.
docs: pyproject.toml
	test -x build/docs/bin/mkdocs || { $(PYTHON) -m venv build/docs && \
		build/docs/bin/pip install --quiet 'mkdocs-material>=9.6' 'mkdocstrings[python]>=1' 'typer>=0.29' 'rich>=13' ruff; }
	NO_MKDOCS_2_WARNING=1 PYTHONPATH=src build/docs/bin/mkdocs build --quiet --strict
	@echo "The site: $(CURDIR)/build/site/index.html"

# The viewer's page: needs node, which nothing else does; what it builds is committed.
viewer:
	cd web && npm ci --no-audit --no-fund && node build.mjs

clean-cache:
	find src -name '*.nb[ci]' -delete

clean:
	rm -rf $(VENV) demo-output reproduction build dist
