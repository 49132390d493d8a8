# `make demo` and `make test` set up what they need in .venv, then run. The second run is quick.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# A requirement that pip takes, or a wheel. The default is what this was tested with.
TORCH ?= torch==2.13.0
# cpu, or cuda for the build with NVIDIA's libraries.
TORCH_BUILD ?= cpu
# Where pip looks for a CPU build of PyTorch if its own index has none for this machine.
TORCH_CPU_INDEX ?= https://download.pytorch.org/whl/cpu
# What the demo needs, and what the tests need besides: extras of pyproject.toml, Debian's packages.
DEMO_EXTRAS := visuals
TEST_EXTRAS := $(DEMO_EXTRAS),icp,notebook,meshes,cluster,train,dif-net,geometric,record,lerobot,realsense,calibration,dev,docs
# Some releases add t64 to a package's name.
DEMO_PACKAGES := libglib2.0-0 libgl1 libegl1 libgl1-mesa-dri libgomp1 python3-venv
TEST_PACKAGES := $(DEMO_PACKAGES) libusb-1.0-0

.PHONY: help setup demo develop check test docs fuzz check-debian13 clean
.DEFAULT_GOAL := help

help:
	@echo "make demo            sets up in $(VENV), grasps a pan, stacks two bowls, writes replays"
	@echo "make setup           sets up what the demo needs, and no more"
	@echo "make test            sets up all extras, checks style and types, runs all tests"
	@echo "make check           style and types alone"
	@echo "make fuzz            runs the property tests on $(FUZZ_INPUTS) inputs each"
	@echo "make docs            builds the documentation as a site"
	@echo "make check-debian13  runs 'make demo' and 'make test' in a bare Debian 13 (as root)"
	@echo "make clean           removes $(VENV) and outputs"
	@echo
	@echo "PYTHON=$(PYTHON) TORCH=$(TORCH) TORCH_BUILD=$(TORCH_BUILD) (or cuda)"
	@echo "TORCH_CPU_INDEX=$(TORCH_CPU_INDEX)"

setup: $(VENV)/.demo

develop: $(VENV)/.test

demo: setup
	@mkdir -p outputs
	$(BIN)/iga simulate diagrams/grasp.yaml --seed 3 --html outputs/grasp.html
	$(BIN)/iga simulate diagrams/stack.yaml --seed 3 --html outputs/stack.html

check: develop
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

docs: develop
	$(BIN)/python -m mkdocs build --strict --config-file .ci/mkdocs.yml --site-dir $(CURDIR)/outputs/site
	@echo "outputs/site/index.html"

test: check docs $(VENV)/.browser
	OMP_NUM_THREADS=1 $(BIN)/pytest -n auto --nbmake notebooks tests

# Many more inputs for the property tests; FUZZ_INPUTS of each, which follow from FUZZ_SEED.
FUZZ_INPUTS ?= 2000
FUZZ_SEED ?= 0
fuzz: develop
	OMP_NUM_THREADS=1 FUZZ_INPUTS=$(FUZZ_INPUTS) $(BIN)/pytest -n auto -m hypothesis --hypothesis-seed=$(FUZZ_SEED) --hypothesis-show-statistics tests

check-debian13:
	.ci/check-debian13

clean:
	rm -rf $(VENV) outputs

# Installs Debian's packages $(1) where they are missing (as root), or names them.
define system_packages
	@missing=""; \
	if command -v dpkg-query >/dev/null 2>&1; then \
	  for package in $(1); do \
	    dpkg-query -W -f='$${Status}\n' $$package $${package}t64 2>/dev/null | grep -q 'ok installed' || missing="$$missing $$package"; \
	  done; \
	fi; \
	if [ "$$missing" = " python3-venv" ] && $(PYTHON) -c 'import ensurepip, venv' 2>/dev/null; then missing=""; fi; \
	if [ -n "$$missing" ]; then \
	  if [ "$$(id -u)" = 0 ]; then \
	    echo "System libraries:$$missing"; \
	    apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -q --no-install-recommends $$missing; \
	  else \
	    echo "missing system libraries, install them with: sudo apt-get install$$missing" >&2; exit 1; \
	  fi; \
	fi
endef

# Installs this project with the extras $(1).
define install_extras
	$(BIN)/python .ci/set_up.py --torch '$(TORCH)' --build $(TORCH_BUILD) --cpu-index '$(TORCH_CPU_INDEX)' --extras $(1)
endef

$(BIN)/python:
	$(call system_packages,$(DEMO_PACKAGES))
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "Python >= 3.11 is needed, $$($(PYTHON) --version) found: make PYTHON=python3.11" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip

$(VENV)/.demo: pyproject.toml Makefile .ci/set_up.py | $(BIN)/python
	$(call install_extras,$(DEMO_EXTRAS))
	@touch $@

$(VENV)/.test: pyproject.toml Makefile .ci/set_up.py | $(BIN)/python
	$(call system_packages,$(TEST_PACKAGES))
	$(call install_extras,$(TEST_EXTRAS))
	@touch $(VENV)/.demo $@

# Pages are tested in headless Chromium; where it is missing and can't be installed, these tests are
# left out.
$(VENV)/.browser: | $(BIN)/python
	@if ! command -v chromium >/dev/null 2>&1 && ! command -v chromium-browser >/dev/null 2>&1; then \
	  if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null 2>&1; then \
	    apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends chromium; \
	  else \
	    echo "no chromium: tests of pages are left out; sudo apt-get install chromium" >&2; exit 0; \
	  fi; \
	fi; touch $@
