# Every target that needs it builds .venv first, from pyproject.toml and constraints.txt.
# The only thing to have is Python 3.10 or newer: make PYTHON=/path/to/python3.12 test

PYTHON ?= python3
VENV := .venv
PY := $(VENV)/bin/python
STAMP := $(VENV)/.installed
PYTEST = OMP_NUM_THREADS=$${OMP_NUM_THREADS:-1} MPLBACKEND=$${MPLBACKEND:-Agg} \
	$(PY) -m pytest -n logical --maxprocesses 4 --dist loadfile
# python -m, not the scripts in .venv/bin: their first line breaks on a path with spaces.
PIP := $(PY) -m pip --disable-pip-version-check --quiet

# Where this is set, as in many containers, each process compiles torch's sources anew: 12 s.
export PYTHONDONTWRITEBYTECODE :=

CODE := sb3_yann envs benchmarks experiments examples tests noxfile.py docs/conf.py docs/pictures.py

.DEFAULT_GOAL := help
.PHONY: help demo paper bench test test-all test-fast coverage check docs format clean

help:  ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "make %-9s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

demo: $(STAMP)  ## run two examples, examples/cstr.py and examples/from_a_log.py
	@$(PY) examples/cstr.py --episodes 16
	@$(PY) examples/from_a_log.py

paper: $(STAMP)  ## run the paper's experiments, hours (make paper ARGS="--quick" for minutes)
	@OMP_NUM_THREADS=$${OMP_NUM_THREADS:-1} $(PY) -m experiments $(ARGS)

bench: $(STAMP)  ## measure the speed, ten minutes (make bench ARGS="--quick" for one)
	@OMP_NUM_THREADS=1 $(PY) -m benchmarks $(ARGS)

test: $(STAMP)  ## run the tests, side by side (make test ARGS="-n 0 -k name" for pytest alone)
	@$(PYTEST) -m "not nightly" $(ARGS)

test-all: $(STAMP)  ## run those of the night too: variety, faults, what needs other tools
	@$(PYTEST) $(ARGS)

test-fast: $(STAMP)  ## run the tests that are not marked slow, in less than two minutes
	@$(PYTEST) -m "not slow and not nightly" $(ARGS)

coverage: $(STAMP)  ## run the tests, and print the lines and branches they leave out
	@rm -rf out/coverage && mkdir -p out/coverage
	@OMP_NUM_THREADS=$${OMP_NUM_THREADS:-1} MPLBACKEND=$${MPLBACKEND:-Agg} \
		$(PY) -m coverage run -m pytest -m "not nightly" -n logical --maxprocesses 4 --dist loadfile $(ARGS)
	@$(PY) -m coverage combine --quiet && $(PY) -m coverage report

check: $(STAMP)  ## lint, check the formatting and the types
	$(PY) -m ruff check $(CODE)
	$(PY) -m ruff format --check $(CODE)
	$(PY) -m mypy

docs: $(STAMP)  ## build the documentation as a site, docs/_build/html/index.html
	@$(PY) -c 'import sphinx' 2>/dev/null || { \
		echo "error: the documentation needs Python 3.11 or newer:" \
			"make clean docs PYTHON=/path/to/python3.12" >&2; exit 1; }
	@$(PY) -m sphinx --quiet --fail-on-warning --keep-going docs docs/_build/html
	@echo "built docs/_build/html/index.html"

format: $(STAMP)  ## format the code and apply the linter's safe fixes
	$(PY) -m ruff check --fix --exit-zero --quiet $(CODE)
	$(PY) -m ruff format $(CODE)

clean:  ## remove .venv, caches and build outputs
	rm -rf $(VENV) build dist docs/_build docs/_made .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find $(CODE) -type d -name __pycache__ -prune -exec rm -rf {} +

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || { \
		echo "error: needs Python 3.10 or newer, and '$(PYTHON)' is not that:" \
			"$$($(PYTHON) --version 2>&1 || true)" >&2; \
		echo "       name another one: make PYTHON=/path/to/python3.12" >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
		echo "error: '$(PYTHON)' lacks its venv module" \
			"(on Debian and Ubuntu: apt install python3-venv)" >&2; exit 1; }
	@$(PY) -m pip --version >/dev/null 2>&1 || { \
		echo "creating $(VENV) with $$($(PYTHON) --version) ..."; \
		$(PYTHON) -m venv --clear $(VENV); }
	@echo "installing into $(VENV), a few minutes the first time (torch is large) ..."
	@$(PIP) install --no-compile -c constraints.txt hatchling
	@$(PIP) install --no-compile -c constraints.txt --no-build-isolation -e '.[dev]'
	@echo "compiling the inner loops, half a minute ..."
	@$(PY) -c 'from sb3_yann.networks._kernels import afterstate_value, yann_layer' & \
		$(PY) -c 'from sb3_yann.control._kernels import online, polyhedra, sweep' & wait
	@touch $@
	@echo "installed into $(VENV)"
