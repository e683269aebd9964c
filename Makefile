# make demo   the sample, from predictions to a merged map and a picture, in demo/
# make test   checks of style and types, then all tests with branch coverage
# make lint   ruff and mypy alone
# make wheel  the package, in dist/
#
# Everything runs in a virtual environment of its own, .venv, which is made when it is needed.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo test lint wheel clean

demo: $(VENV)/runtime
	$(BIN)/python -m polymerge_core demo demo --overwrite

test: lint $(VENV)/test
	$(BIN)/python -m pytest -n auto --dist worksteal --cov --cov-report=term

lint: $(VENV)/lint
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

wheel: $(VENV)/runtime
	$(BIN)/python -m pip install --quiet build
	$(BIN)/python -m build

clean:
	rm -rf $(VENV) build dist demo .coverage .hypothesis .mypy_cache .pytest_cache .ruff_cache

# Debian ships venv apart from Python.
$(VENV)/python:
	@$(PYTHON) -c "import ensurepip" 2>/dev/null || { \
	  echo "python3-venv is missing: installing it"; \
	  SUDO=$$( [ "$$(id -u)" = 0 ] || echo sudo ); \
	  $$SUDO apt-get update -qq && $$SUDO apt-get install -y -qq python3-venv; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	touch $@

$(VENV)/runtime: $(VENV)/python pyproject.toml
	$(BIN)/python -m pip install --quiet --editable .
	touch $@

$(VENV)/test: $(VENV)/runtime
	$(BIN)/python -m pip install --quiet --editable ".[test]"
	touch $@

$(VENV)/lint: $(VENV)/runtime
	$(BIN)/python -m pip install --quiet --editable ".[lint]"
	touch $@
