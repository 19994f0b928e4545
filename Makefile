# make study   one command to a certified, learned and verified high jump (report in runs/study)
# make test    the tests that CI runs
# make lint    ruff, pyright, import-linter
#
# Needs Python 3.11 or newer and the package registry; everything goes into .venv. The two
# stamp files there remember what is installed, so it is done once until the pins change.

PYTHON ?= $(shell for p in python3.11 python3 python3.12 python3.13 python; do \
	$$p -c 'import sys, venv, ensurepip; assert sys.version_info >= (3, 11)' 2>/dev/null \
	&& echo $$p && break; done)
PIPFLAGS ?=
OUT ?= runs/study
WORKERS ?= 2

VENV := .venv
PY := $(VENV)/bin/python
PINS := pyproject.toml constraints.txt
NOTEBOOKS := $(wildcard notebooks/*.ipynb)
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: study test lint clean-venv

study: $(VENV)/.installed-core
	$(VENV)/bin/olympics-opt study high_jump --out $(OUT)

test: $(VENV)/.installed-dev
	OMP_NUM_THREADS=1 $(PY) -m pytest -q -n $(WORKERS) --dist loadfile -m "not slow" \
		--nbmake --nbmake-timeout=120 tests $(NOTEBOOKS)

lint: $(VENV)/.installed-dev
	@status=0; for check in "ruff check ." "ruff format --check ." pyright lint-imports; do \
		echo "$$check"; $(VENV)/bin/$$check || status=1; done; exit $$status

$(VENV)/.installed-core: $(PINS) | $(VENV)/bin/pip
	$(PY) -m pip install $(PIPFLAGS) -c constraints.txt -e .
	touch $@

$(VENV)/.installed-dev: $(PINS) | $(VENV)/bin/pip
	$(PY) -m pip install $(PIPFLAGS) -c constraints.txt -e '.[dev]'
	touch $@ $(VENV)/.installed-core

# pip is the last thing that venv writes: a venv without it was interrupted, and is made anew.
$(VENV)/bin/pip:
	@test -n "$(PYTHON)" || { echo "Python 3.11 or newer with the venv module was not found:" \
		"install it (Debian: python3.11-venv) or run make PYTHON=/path/to/python." >&2; exit 2; }
	$(PYTHON) -m venv --clear $(VENV)

clean-venv:
	rm -rf $(VENV)
