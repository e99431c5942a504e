# Needs Python 3.11, 3.12 or 3.13, make and a network; all else comes from the lock in requirements/.
PYTHON ?= python3
VENV := .venv
GPU :=
ARGS :=
AGENT := agent-b

BIN := $(VENV)/bin
UV_VERSION := 0.13.9

ifeq ($(filter "$(GPU)","" "cuda12" "cuda13"),)
$(error GPU is cuda12 or cuda13, or left out for the CPU, and not '$(GPU)')
endif

# The stamp is written last and names the lock, so that half an environment is never taken for a
# whole one. `make setup` without GPU means the CPU; the others keep what is installed.
INSTALLED := $(patsubst $(VENV)/.locked-%,%,$(wildcard $(VENV)/.locked-*))
LOCK := $(or $(GPU),$(if $(filter setup,$(MAKECMDGOALS)),,$(INSTALLED)),cpu)
STAMP := $(VENV)/.locked-$(LOCK)

PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check
SUPPORTED := import sys; sys.exit(sys.version_info[:2] not in {(3, 11), (3, 12), (3, 13)})

.PHONY: help setup train play test test-slow test-long test-campaign peers test-peers onnx test-onnx docs \
  test-docs format lock lock-peers lock-onnx lock-docs clean

help:
	@echo "make setup      build $(VENV) from the lock; GPU=cuda12 or GPU=cuda13 for NVIDIA"
	@echo "make train      train; ARGS=\"...\" goes to train.py"
	@echo "make play       video.mp4 of a shipped agent; AGENT=..., ARGS=\"--env A --out other.mp4\""
	@echo "make test       ruff, mypy and the default tests"
	@echo "make test-slow  the tests marked slow"
	@echo "make test-long  the tests marked long, an hour or more; CI leaves them out"
	@echo "make test-campaign  tries to break runs and files, two hours; ARGS=\"--parts kills\" for a part"
	@echo "make peers      build $(PEERS) with what we are measured against"
	@echo "make test-peers the tests of the adapters, with trainers of others"
	@echo "make onnx       build $(ONNX), whose mjx-arm export has --format onnx"
	@echo "make test-onnx  the test of ONNX, there"
	@echo "make docs       build the documentation, with its notebooks, and check its links"
	@echo "make test-docs  open the built pages in Chromium, as wide as a desktop and as a phone"
	@echo "make format     let ruff rewrite the sources"
	@echo "make lock       resolve the lock again; ARGS=--upgrade for the newest versions"
	@echo "make clean      remove caches and built packages (not $(VENV), not runs/)"
	@echo "PYTHON=...      the Python 3.11, 3.12 or 3.13 that $(VENV) is built with (python3)"

setup: $(STAMP)
	@echo "$(VENV) is ready ($(LOCK), $$($(BIN)/python --version)): make train, make test, $(BIN)/mjx-arm --help"

$(VENV)/.locked-%: requirements/%.txt
	@$(PYTHON) -c "$(SUPPORTED)" 2>/dev/null || \
	  { echo "Python 3.11, 3.12 or 3.13 is needed, and '$(PYTHON)' is another: try make PYTHON=python3.12" >&2; exit 2; }
	@test ! -e $(VENV) || test -e $(VENV)/pyvenv.cfg || \
	  { echo "$(VENV) is there and is no virtual environment: move it away" >&2; exit 2; }
	@echo "Installing $< into $(VENV): minutes, the first time."
	@rm -f $(VENV)/.locked-*
	@$(PYTHON) -m venv --clear $(VENV)
	@$(PIP) --require-hashes --only-binary :all: -r $<
	@$(PIP) --no-build-isolation --no-deps --editable .
	@touch $@

train: $(STAMP)
	$(BIN)/python train.py $(ARGS)

play: $(STAMP)
	$(BIN)/mjx-arm play $(AGENT) $(ARGS)

test: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest --numprocesses auto --dist loadfile

# Two at a time: most of a test is compiling. More would disturb those that keep to real time.
test-slow: $(STAMP)
	$(BIN)/python -m pytest --numprocesses 2 --dist loadfile -m slow

test-long: $(STAMP)
	$(BIN)/python -m pytest -m long

# Outside the repository nothing is written; ARGS="--table FILE" keeps the results.
test-campaign: $(STAMP)
	$(BIN)/python benchmarks/campaign.py $(ARGS)

# What we are measured against has an environment of its own, on Linux with Python 3.11. Its torch
# is the CPU build, which PyTorch has in a place of its own: name that in PIP_FIND_LINKS.
PEERS := .venv-peers

peers: $(PEERS)/.locked
	@echo "$(PEERS) is ready: $(PEERS)/bin/python benchmarks/peers.py"

$(PEERS)/.locked: requirements/peers.txt
	@$(PYTHON) -m venv --clear $(PEERS)
	@$(PEERS)/bin/python -m pip install --quiet --disable-pip-version-check \
	  --require-hashes --only-binary :all: -r $<
	@$(PEERS)/bin/python -m pip install --quiet --disable-pip-version-check \
	  --no-build-isolation --no-deps --editable .
	@touch $@

# Only files that import nothing which the peers' environment lacks.
PEERS_TESTS := tests/interop tests/docs/test_snippets.py

test-peers: $(PEERS)/.locked
	$(PEERS)/bin/python -m pytest -m peers $(PEERS_TESTS)

# jax2onnx excludes the orbax-checkpoint that training needs, so ONNX has an environment of its own.
ONNX := .venv-onnx

onnx: $(ONNX)/.locked
	@echo "$(ONNX) is ready: $(ONNX)/bin/mjx-arm export AGENT --format onnx --out FILE"

$(ONNX)/.locked: requirements/onnx.txt
	@$(PYTHON) -m venv --clear $(ONNX)
	@$(ONNX)/bin/python -m pip install --quiet --disable-pip-version-check \
	  --require-hashes --only-binary :all: -r $<
	@$(ONNX)/bin/python -m pip install --quiet --disable-pip-version-check \
	  --no-build-isolation --no-deps --editable .
	@touch $@

test-onnx: $(ONNX)/.locked
	$(ONNX)/bin/python -m pytest -m onnx tests/test_onnx.py

# The documentation is built in an environment of its own, with the versions of the CPU's lock.
DOCS := .venv-docs
SITE := docs/_build/html

docs: $(DOCS)/.locked
	$(DOCS)/bin/python -m sphinx --quiet --fail-on-warning --keep-going \
	  --doctree-dir docs/_build/doctrees docs $(SITE)
	$(DOCS)/bin/python docs/check_site.py $(SITE)
	@echo "open $(SITE)/index.html"

# In the environment of the tests, which has playwright.
test-docs: $(STAMP)
	$(BIN)/python docs/check_browser.py $(SITE)

$(DOCS)/.locked: requirements/docs.txt
	@$(PYTHON) -m venv --clear $(DOCS)
	@$(DOCS)/bin/python -m pip install --quiet --disable-pip-version-check \
	  --require-hashes --only-binary :all: -r $<
	@$(DOCS)/bin/python -m pip install --quiet --disable-pip-version-check \
	  --no-build-isolation --no-deps --editable .
	@touch $@

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

lock: .venv-lock/bin/uv-$(UV_VERSION)
	@$(call compile,cpu)
	@$(call compile,cuda12,--extra cuda12)
	@$(call compile,cuda13,--extra cuda13)

lock-peers: .venv-lock/bin/uv-$(UV_VERSION)
	@echo "torch==2.13.0+cpu" > .venv-lock/constraints.txt
	@UV_CUSTOM_COMPILE_COMMAND="make lock-peers" .venv-lock/bin/uv pip compile pyproject.toml \
	  --no-config --quiet --python-platform x86_64-manylinux_2_28 --python-version 3.11 \
	  --generate-hashes --no-emit-index-url --no-emit-find-links --find-links "$(PIP_FIND_LINKS)" \
	  --constraints .venv-lock/constraints.txt --extra peers $(ARGS) --output-file requirements/peers.txt
	@sed -i 's/^torch==\([0-9.]*\)+cpu/torch==\1/' requirements/peers.txt

# The override is what makes jax2onnx and mjx_arm fit: an export reads no checkpoint.
lock-onnx: .venv-lock/bin/uv-$(UV_VERSION)
	@echo "orbax-checkpoint<0.11.37" > .venv-lock/overrides.txt
	@UV_CUSTOM_COMPILE_COMMAND="make lock-onnx" .venv-lock/bin/uv pip compile pyproject.toml requirements/onnx.in \
	  --no-config --quiet --universal --python-version 3.11 --generate-hashes --no-emit-index-url \
	  --override .venv-lock/overrides.txt $(ARGS) --output-file requirements/onnx.txt

# The same versions as in the CPU's lock, so that the notebooks run what the tests run.
lock-docs: .venv-lock/bin/uv-$(UV_VERSION)
	@UV_CUSTOM_COMPILE_COMMAND="make lock-docs" .venv-lock/bin/uv pip compile pyproject.toml \
	  --no-config --quiet --universal --python-version 3.11 --generate-hashes --no-emit-index-url \
	  --constraints requirements/cpu.txt --extra docs $(ARGS) --output-file requirements/docs.txt

# One file serves Python 3.11 to 3.13, Linux and macOS: markers choose among the versions.
compile = UV_CUSTOM_COMPILE_COMMAND="make lock" .venv-lock/bin/uv pip compile pyproject.toml \
  --no-config --quiet --universal --python-version 3.11 --generate-hashes --no-emit-index-url \
  --extra dev $(2) $(ARGS) --output-file requirements/$(1).txt

.venv-lock/bin/uv-$(UV_VERSION):
	@$(PYTHON) -m venv --clear .venv-lock
	@.venv-lock/bin/python -m pip install --quiet --disable-pip-version-check uv==$(UV_VERSION)
	@touch $@

clean:
	rm -rf build dist docs/_build .mypy_cache .pytest_cache .ruff_cache .venv-lock
	find mjx_arm tests benchmarks -name __pycache__ -type d -prune -exec rm -rf {} + 2>/dev/null || true
