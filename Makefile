# Everything runs in .venv, which the first target makes; only Python 3.11+, make and git are needed beforehand.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: demo test lint bench bench-check docs package-check clean
.DEFAULT_GOAL := demo

$(STAMP): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "rmis_calib needs Python 3.11 or newer; set PYTHON=/path/to/python3.11")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	@touch $@

demo: $(STAMP)  ## render a stereo recording, calibrate it, leave demo_output/report.html
	$(BIN)/rmis-calib demo --out demo_output --overwrite

test: $(STAMP)  ## every test, the import contracts and the documentation's Python
	PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -q -n auto --dist loadfile --no-loadscope-reorder

lint: $(STAMP)  ## ruff and pyright
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright

bench: $(STAMP)  ## every table that the documentation quotes (long)
	set -e; for f in tests/benchmarks/bench_*.py; do echo "== $$f"; $(BIN)/python $$f; done

bench-check: $(STAMP)  ## a few minutes of benchmarks against tests/benchmarks/baseline.json
	$(BIN)/python tests/benchmarks/check.py

docs: $(STAMP)  ## the documentation as a site that opens from disk: build/site/index.html
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

package-check: $(STAMP)  ## build wheel and sdist twice, compare, install the wheel elsewhere and use it
	$(BIN)/python -m pytest -q tests/packaging

clean:
	rm -rf $(VENV) demo_output build dist .pytest_cache .ruff_cache .hypothesis
