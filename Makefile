# Two commands matter: `make demo` runs the main job, `make test` proves the build. CONTRIBUTING.md has the others.
# Each sets up the virtual environment it needs, with the exact versions of constraints.txt.

# Python, or Debian's own where that is the same version, if one of them was built with optimization, which saves 13 % of
# a simulation's CPU time.
OPTIMIZED := import ensurepip, sys, sysconfig, venv; \
	sys.exit(sys.base_prefix != "/usr" and "--enable-optimizations" not in str(sysconfig.get_config_var("CONFIG_ARGS")))
PYTHON ?= $(shell for python in python3 /usr/bin/python3; do \
	[ "$$($$python -V | cut -d. -f-2)" = "$$(python3 -V | cut -d. -f-2)" ] && $$python -c '$(OPTIMIZED)' && echo $$python && exit; \
	done 2>/dev/null; echo python3)
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
PYTEST := $(BIN)/pytest --dist worksteal -n
# Whole runs, which come first, wait for processes, connections and timers while other workers compute: half as many
# workers again as cores keep all cores busy.
CORES := $(shell nproc 2>/dev/null || echo 1)
WAITING := $(shell expr \( 3 \* $(CORES) + 1 \) / 2)
COVERAGE := --cov --cov-report=

# Bytecode is kept, also where the environment says otherwise: without it each worker compiles all tests, and each
# process that a test starts compiles vnet.
export PYTHONDONTWRITEBYTECODE :=

# What `make test-all` tests with, each in a virtual environment of its own, if it is installed.
PYTHONS ?= 3.11 3.12 3.13

.PHONY: demo test tests coverage test-all quick lint docs site bench soak fuzz hunt sumo radios setup clean

setup: $(READY)

$(READY): pyproject.toml studies/pyproject.toml constraints.txt
	@command -v $(PYTHON) >/dev/null || { echo "vnet needs Python 3.11 or newer: apt-get install python3 python3-venv"; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "vnet needs Python 3.11 or newer; $(PYTHON) is $$($(PYTHON) -V). Try: make PYTHON=python3.11 $(MAKECMDGOALS)"; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { echo "Python's venv module is missing: apt-get install python3-venv"; exit 1; }
	$(PYTHON) -m venv --clear $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]' -e ./studies
	@$(PYTHON) -c '$(OPTIMIZED)' || echo "note: $(PYTHON) was built without optimization: a simulation takes 1.15 times the CPU time of Debian's"
	@touch $(READY)

demo: $(READY)
	$(BIN)/vnet run scenarios/quickstart.toml --rerun save

# Coverage's tracer makes of 27 s of CPU time 47, so it is at work in `make coverage` alone.
# Side by side: mypy, alone, would leave all cores but one idle for as long as a quarter of the tests take.
test: $(READY)
	@$(MAKE) --no-print-directory --jobs 2 lint tests

tests: $(READY)
	@$(PYTEST) $(WAITING)

coverage: $(READY)
	@$(PYTEST) $(CORES) -m "not slow" $(COVERAGE)
	@echo "Lines that ran in the tests that are not slow, in total and in the ten files with the fewest:"
	@$(BIN)/coverage report --sort=cover | sed -n '1,12p;$$p'

quick: $(READY)
	$(PYTEST) auto -m "not slow" --ignore=tests/system

test-all:
	@tested=; failed=; for version in $(PYTHONS); do \
		for python in "$$(command -v python$$version)" $$(ls -d "$$HOME"/.pyenv/versions/$$version.*/bin/python 2>/dev/null); do \
			"$$python" -c 'import venv' 2>/dev/null && break; python=; \
		done; \
		if [ -z "$$python" ]; then echo "Python $$version is not installed: not tested"; continue; fi; \
		echo "Python $$version: $$python"; tested="$$tested $$version"; \
		$(MAKE) test PYTHON="$$python" VENV=.venv-$$version || failed="$$failed $$version"; \
	done; \
	if [ -z "$$tested" ]; then echo "none of Python $(PYTHONS) is installed"; exit 1; fi; \
	if [ -n "$$failed" ]; then echo "tested with Python$$tested; failed:$$failed"; exit 1; fi; \
	echo "passed with Python$$tested"

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/codespell

docs: $(READY)
	$(BIN)/python -m docs.generate

site: $(READY)
	$(BIN)/sphinx-build -q -W -c docs/site . site
	@echo "open site/index.html"

bench: $(READY)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[bench]'
	$(BIN)/python -m benchmarks

fuzz: $(READY)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[fuzz]'
	$(BIN)/python -m tests.fuzz --runs 1000000

# SUMO as a library: 100 MB to fetch, so that `make test` does without, and with a stand-in for it.
sumo: $(READY)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt libsumo
	$(BIN)/pytest -n 0 tests/emulator/world/driven/test_sumo_itself.py
	$(BIN)/pytest -n 0 tests/docs/test_blocks.py -k sumo-in-the-loop

radios: $(READY)
	CURVES_S="60 60 3" $(BIN)/pytest -n 2 tests/benchmarks/test_cv2x.py -k published_curves

hunt: $(READY)
	$(BIN)/python -m tests.hunt
	$(BIN)/python -m tests.hunt.layouts

soak: $(READY)
	$(BIN)/python -m benchmarks.soak

clean:
	rm -rf .venv .venv-* build site *.egg-info .coverage .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -prune -exec rm -r {} +
