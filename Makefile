# `check` never edits, `fix` does, `test` tests.
PYTHON ?= python3
BIN := .venv/bin
INSTALLED := .venv/.installed

PROCESSES ?= 2

.PHONY: setup demo test test-e2e test-slow coverage check fix bench dist docs generate protocol clean
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
test test-e2e test-slow: export PYTHONDONTWRITEBYTECODE =

# $(call run,NAME,SECONDS,OPTIONS): a test that fails passes if it then passes alone, except where TESTS or PYTEST is set.
run = $(BIN)/python $(if $(TESTS)$(PYTEST),-m pytest,scripts/run_tests.py $(1) $(2)) $(3) --dist loadscope $(PYTEST) $(TESTS)

# Every few minutes of work: all that is not slow by nature, in $(PROCESSES) processes. TESTS=tests/league runs a part.
test: setup
	$(call run,quick,3000,-m "not slow and not e2e" -n $(PROCESSES))

# One test for each promise that no quick test keeps, one after another.
test-e2e: setup
	$(call run,e2e,1500,-m e2e -n 1)

# Branch coverage of product code by the quick tests, which take almost twice as long with it.
coverage: setup
	$(MAKE) test PYTEST="--cov --cov-report= $(PYTEST)"
	$(BIN)/coverage report --skip-covered --sort=cover

# Learning to a level, every environment, kills and clusters: PART=serving or TESTS=tests/cli runs some of them. A cluster
# that serves under load needs all cores; clients in other languages need Node.js 20 and npm's registry.
pages := tests/browser tests/test_docs.py
serving := tests/serve_app tests/cli tests/policy_league_client tests/test_tutorial.py tests/test_wheel.py
training := tests/training tests/examples tests/test_environments.py tests/test_restore_parity.py
evaluation := tests/evaluation tests/league tests/benchmarks tests/test_run_tests.py
clusters := tests/cluster tests/clients
upgrade := tests/upgrade
PARTS := pages serving training evaluation clusters upgrade

test-slow: $(addprefix slow-,$(if $(TESTS),tests,$(or $(PART),$(PARTS))))

slow-%: setup
	$(BIN)/python -m pytest -m slow -n $(if $(filter clusters,$*),0,$(PROCESSES)) --dist loadscope $(PYTEST) $(or $(TESTS),$($*))

check: setup
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python scripts/generate_sync_client.py --check
	$(BIN)/python scripts/benchmark_page.py --check
	$(BIN)/python -m scripts.checks

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
