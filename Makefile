# `make demo` and `make test` set up everything in .venv, then run. The second run is quick.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# The release that this was tested with; where pip would fetch CUDA with it, name a CPU build:
# make TORCH=... (a version or a wheel). A newer Python gets the newest torch.
TORCH ?= torch==2.13.0
EXTRAS := icp,visuals,notebook,meshes,cluster,train,dif-net,dev
# Some releases add t64 to a package's name.
PACKAGES := libglib2.0-0 libusb-1.0-0 libgl1 libegl1 libgl1-mesa-dri libgomp1 python3-venv

.PHONY: demo test check setup clean
.DEFAULT_GOAL := setup

setup: $(VENV)/.installed

demo: setup
	@mkdir -p outputs
	$(BIN)/iga simulate diagrams/grasp.yaml --seed 3 --html outputs/grasp.html
	$(BIN)/iga simulate diagrams/stack.yaml --seed 3 --html outputs/stack.html

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

test: check $(VENV)/.browser
	OMP_NUM_THREADS=1 $(BIN)/pytest -n auto --nbmake tests notebooks

clean:
	rm -rf $(VENV) outputs

$(VENV)/.system:
	@missing=""; \
	if command -v dpkg-query >/dev/null 2>&1; then \
	  for package in $(PACKAGES); do \
	    dpkg-query -W -f='$${Status}\n' $$package $${package}t64 2>/dev/null | grep -q 'ok installed' || missing="$$missing $$package"; \
	  done; \
	fi; \
	if [ "$$missing" = " python3-venv" ] && $(PYTHON) -c 'import ensurepip, venv' 2>/dev/null; then missing=""; fi; \
	if [ -n "$$missing" ]; then \
	  if [ "$$(id -u)" = 0 ]; then \
	    apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $$missing; \
	  else \
	    echo "missing system libraries, install them with: sudo apt-get install$$missing" >&2; exit 1; \
	  fi; \
	fi
	@mkdir -p $(VENV) && touch $@

# Pages are tested in headless Chromium; where it is missing and can't be installed, these tests are
# left out.
$(VENV)/.browser: | $(VENV)/.system
	@if ! command -v chromium >/dev/null 2>&1 && ! command -v chromium-browser >/dev/null 2>&1; then \
	  if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null 2>&1; then \
	    apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends chromium; \
	  else \
	    echo "no chromium: tests of pages are left out; sudo apt-get install chromium" >&2; exit 0; \
	  fi; \
	fi; touch $@

$(BIN)/python: | $(VENV)/.system
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "Python >= 3.11 is needed, $$($(PYTHON) --version) found: make PYTHON=python3.11" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip

$(VENV)/.torch: | $(BIN)/python
	$(BIN)/python -m pip install --quiet "$$($(BIN)/python -c 'import sys; print("$(TORCH)" if sys.version_info[:2] == (3, 11) else "torch")')"
	@touch $@

$(VENV)/.installed: pyproject.toml Makefile | $(VENV)/.torch
	$(BIN)/python -m pip install --quiet -e ".[$(EXTRAS)]"
	@touch $@
