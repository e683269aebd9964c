# make demo     the sample, from predictions to a merged map and a picture, in demo/
# make plugin   the QGIS plugin, polymerge.zip; needs Python alone
# make test     checks of style and types, then all tests with branch coverage, in QGIS too
# make lint     ruff and mypy, and the checks that plugins.qgis.org makes of an uploaded plugin
# make wheel    the package, in dist/
#
# Everything runs in virtual environments of its own, which are made when they are needed: .venv for the library, and
# .venv-qgis, which holds pytest beside the QGIS of the system (where there is none, make test installs Debian's). QGIS_PYTHON
# is the interpreter that has QGIS's modules.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
QGIS_PYTHON ?= /usr/bin/python3
QGIS_VENV := .venv-qgis
UNPACKED := build/plugin

.PHONY: demo plugin test test-core test-qgis lint lint-plugin wheel qgis clean

demo: $(VENV)/runtime
	$(BIN)/python -m polymerge_core demo demo --overwrite

plugin:
	$(PYTHON) qgis_plugin/package.py

test: lint test-core test-qgis

# POLYMERGE_QGIS=required: a test of the plugin that would be skipped is a failure.
test-core: $(VENV)/test qgis
	POLYMERGE_QGIS=required $(BIN)/python -m pytest -n auto --dist worksteal --cov --cov-report=term

# The tests that live inside QGIS's own Python; those of the library, and what they import, stay out of it.
test-qgis: export QT_QPA_PLATFORM := offscreen
test-qgis: export COVERAGE_FILE := .coverage_qgis
test-qgis: export POLYMERGE_QGIS := required
test-qgis: $(QGIS_VENV)/test
	$(QGIS_VENV)/bin/python -m pytest tests/qgis/hosted --confcutdir=tests/qgis -n auto --dist worksteal \
	  --cov=qgis_plugin --cov-branch --cov-report=term --cov-fail-under=85

lint: $(VENV)/lint lint-plugin
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# QGS201 and QGS202 guess by a method's name that it belongs to QGIS, and are left to the eye.
# detect-secrets scan exits 0 whatever it finds; its hook does not. What it is told to leave out the site leaves out too.
lint-plugin: $(VENV)/lint plugin
	rm -rf $(UNPACKED)
	$(BIN)/python -m zipfile -e polymerge.zip $(UNPACKED)
	$(BIN)/flake8 --isolated --select=E9,F821,F823,F831,QGS --extend-ignore=QGS201,QGS202 $(UNPACKED)
	$(BIN)/bandit --quiet --configfile pyproject.toml --recursive $(UNPACKED)
	find $(UNPACKED) -type f | xargs $(BIN)/detect-secrets-hook --no-verify --disable-plugin IPPublicDetector

wheel: $(VENV)/runtime
	$(BIN)/python -m pip install --quiet build
	$(BIN)/python -m build

clean:
	rm -rf $(VENV) $(QGIS_VENV) build dist demo polymerge.zip .coverage .coverage_qgis .hypothesis .mypy_cache \
	  .pytest_cache .qgis-settings .ruff_cache

APT_GET := $(if $(filter 0,$(shell id -u)),,sudo) env DEBIAN_FRONTEND=noninteractive apt-get

# $(call venv,PYTHON,FOLDER,FLAGS): make a virtual environment. Debian ships venv apart from Python.
define venv
@$(1) -c "import ensurepip" 2>/dev/null || { \
  echo "python3-venv is missing: installing it"; \
  $(APT_GET) update -qq && $(APT_GET) install -y -qq python3-venv; }
$(1) -m venv $(3) $(2)
$(2)/bin/python -m pip install --quiet --upgrade pip
endef

# QGIS as the tests need it: its Processing plugin (python3-qgis), a screen, and a font, without which text is blank.
qgis:
	@{ [ -x /usr/bin/qgis_process.bin ] || command -v qgis_process >/dev/null; } && command -v Xvfb >/dev/null || { \
	  echo "QGIS or Xvfb is missing: installing it"; \
	  $(APT_GET) update -qq && $(APT_GET) install -y -qq --no-install-recommends \
	    qgis python3-qgis xvfb xauth fonts-dejavu-core; }
	@$(QGIS_PYTHON) -c "import qgis.core" || { \
	  echo "$(QGIS_PYTHON) has no QGIS modules: name the interpreter that has, as in make test QGIS_PYTHON=..."; exit 1; }

$(VENV)/python:
	$(call venv,$(PYTHON),$(VENV))
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

# Nothing else may go in here: QGIS must find the system's numpy and the like.
$(QGIS_VENV)/test: | qgis
	$(call venv,$(QGIS_PYTHON),$(QGIS_VENV),--system-site-packages)
	$(QGIS_VENV)/bin/python -m pip install --quiet "pytest>=8" "pytest-qgis>=3" "pytest-cov>=5" "pytest-xdist>=3"
	touch $@

# The pictures of docs/qgis.md, taken in the desktop of QGIS.
.PHONY: screenshots
screenshots: $(VENV)/runtime qgis
	$(BIN)/python -m tests.qgis.desktop.desktop docs/images
