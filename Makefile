# A machine with Python >= 3.11, pip and make is enough: everything else goes into .venv.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready

.PHONY: run test lint docs clean help

help:
	@echo "make run    the default scenario, headless, into runs/three_tracks"
	@echo "make test   the test suite, on two processors"
	@echo "make lint   ruff, mypy and the import rules"
	@echo "make docs   the pages as a site, build/site/index.html"
	@echo "make clean  remove .venv, build and runs"

run: $(READY)
	$(BIN)/trainctl run

test: $(READY)
	$(BIN)/python -m pytest -n 2 --dist worksteal --durations=25

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

docs: $(READY)
	$(BIN)/python tools/site.py

# The last lines compile the kernels once, so that no first run waits for them: the default scenario's, then all others on all cores.
$(READY): requirements.lock pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "trainctl needs Python 3.11 or later")'
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --requirement requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-build-isolation --no-deps --editable .
	$(BIN)/trainctl run three_tracks --backend numeric --set run.duration_s=8 --out .venv/first-run --quiet
	$(BIN)/python tools/compile_kernels.py
	@touch $(READY)

clean:
	rm -rf .venv build runs
