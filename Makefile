# `check` never edits, `fix` does, `test` tests.
PYTHON ?= python3
BIN := .venv/bin
INSTALLED := .venv/.installed

PROCESSES ?= 3

.PHONY: setup demo test test-slow test-clients coverage check fix bench dist docs generate protocol clean
.DEFAULT_GOAL := setup

# LOCKED=1 installs the files of requirements/ and no others: Linux on x86-64 only.
setup: $(INSTALLED)

LOCK := requirements/linux-x86_64
HASHED := $(BIN)/python -m pip install --quiet --require-hashes --no-deps

$(INSTALLED): pyproject.toml constraints.txt $(wildcard requirements/*.txt)
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Policy League needs Python 3.11 or newer: make PYTHON=python3.11 …")'
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
ifdef LOCKED
	$(HASHED) --requirement $(LOCK)-build.txt
	$(HASHED) --no-build-isolation --requirement $(LOCK).txt
	$(HASHED) --requirement $(LOCK)-cpu.txt || $(HASHED) --requirement $(LOCK)-cuda.txt
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	$(BIN)/python -m pip check
else
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[dev,docs,environments]"
endif
	@touch $@

demo: setup
	$(BIN)/league demo $(DEMO)

# Tests start many processes, which share compiled modules.
test test-slow: export PYTHONDONTWRITEBYTECODE =

# Every few minutes of work: all that is not slow by nature, in $(PROCESSES) processes. TESTS=tests/league runs a part.
test: setup
	$(BIN)/python -m pytest -m "not slow" -n $(PROCESSES) --dist loadscope $(PYTEST) $(TESTS)

# Branch coverage of product code by the quick tests, which take almost twice as long with it.
coverage: setup
	$(MAKE) test PYTEST="--cov --cov-report= $(PYTEST)"
	$(BIN)/coverage report --skip-covered --sort=cover

# Learning to a level, every environment, kills and clusters. A cluster that serves under load needs all cores: its tests
# run alone.
test-slow: setup
ifdef TESTS
	$(BIN)/python -m pytest -m slow -n $(PROCESSES) --dist loadscope $(PYTEST) $(TESTS)
else
	$(BIN)/python -m pytest -m slow -n $(PROCESSES) --dist loadscope $(PYTEST) --ignore tests/cluster/test_cluster.py --ignore tests/clients
	$(BIN)/python -m pytest -m slow $(PYTEST) tests/cluster/test_cluster.py
endif

# Clients in other languages, with their own package managers: `npm ci` needs npm's registry.
test-clients: setup
	$(BIN)/python -m pytest -m slow $(PYTEST) tests/clients

check: setup
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python scripts/generate_sync_client.py --check
	$(BIN)/python scripts/benchmark_page.py --check
	$(BIN)/python scripts/check_names.py

fix: setup
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

bench: setup
	$(BIN)/python -m benchmarks $(or $(BENCH),all)

# The distributions of both projects, with the pinned setuptools.
dist: setup
	rm -rf dist
	$(BIN)/python -m build --no-isolation --outdir dist .
	$(BIN)/python -m build --no-isolation --outdir dist clients/python

# The documentation as a site, in build/site. Fails on a broken link.
docs: setup
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

generate: setup protocol
	$(BIN)/python scripts/generate_sync_client.py
	$(BIN)/python scripts/benchmark_page.py
	PYTHONPATH=. $(BIN)/python scripts/generate_typescript.py

# The messages of gRPC, in a descriptor pool of their own: a process may hold others of the same names (tritonclient's).
PROTOCOL := serve_app/inference_protocol
protocol: setup
	$(BIN)/python -m grpc_tools.protoc -I $(PROTOCOL) --python_out=$(PROTOCOL) --pyi_out=$(PROTOCOL) open_inference.proto
	sed -i 's/_descriptor_pool.Default()/_descriptor_pool.DescriptorPool()/' $(PROTOCOL)/open_inference_pb2.py

clean:
	rm -rf .venv build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
