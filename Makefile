# Everything on a fresh machine with Python 3.11 or newer and make:
#   make map     drive through a rendered port and map it
#   make test    run the tests
#   make check   format, lint, types, import contracts
#   make docs    build the documentation's site into site/
#   make audit   known weaknesses of the installed packages
#   make installs  the wheel with one extra at a time: what the documents promise there
#   make dist    wheel and source archive, in dist/
#   make sbom    the parts of an installation with versions and licences (CycloneDX), in dist/
# Further arguments: make map ARGS="+run=port1"

PYTHON ?= python3
ARGS ?= +run=port2
VENV := .venv
BIN := $(VENV)/bin
# What is compiled once is there for the hundreds of processes that tests start, whatever the environment says.
export PYTHONDONTWRITEBYTECODE :=
# Python compiles the few modules that are imported; to compile all that is installed takes half a minute.
INSTALL = $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt
# A release with a known weakness: where a mirror has no advisory of it, it has none at all.
ADVISORIES := https://pypi.org/pypi/PyYAML/5.3/json
# An empty file per set of packages: while it is newer than what it depends on, nothing is installed.
MAP_INSTALLED := $(VENV)/.installed-map
DEV_INSTALLED := $(VENV)/.installed-dev
SBOM_TOOLS := $(VENV)-sbom/bin/cyclonedx-py
# What an installation is made of: the kernels are compiled by it.
INSTALLED_FROM := pyproject.toml constraints.txt hatch_build.py $(wildcard v2hdm/native/src/*)

.PHONY: map test check docs audit installs installed dist sbom clean

map: $(MAP_INSTALLED)
	$(BIN)/python -m v2hdm.map $(ARGS)

installed: $(DEV_INSTALLED)

# The tests run side by side; more threads in each would only get in their way. In the order of their folders
# the last files are short: by their numbers of tests, the last ones would be long files of a test or two.
test: export OMP_NUM_THREADS = 1
test: $(DEV_INSTALLED)
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

check: $(DEV_INSTALLED)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

docs: $(DEV_INSTALLED)
	$(BIN)/python docs/tools/site.py site

audit: $(DEV_INSTALLED)
	@$(BIN)/python -c "import urllib.request as u; assert b'CVE-' in u.urlopen('$(ADVISORIES)', timeout=10).read()" \
		2>/dev/null || { echo "audit skipped: no advisories at $(ADVISORIES)"; exit 0; }; \
		$(BIN)/python -m pip_audit --skip-editable --progress-spinner off

installs: $(DEV_INSTALLED)
	PYTHONPATH=. $(BIN)/python .ci/installs.py

dist: $(DEV_INSTALLED)
	$(BIN)/python -m build --outdir dist
	$(BIN)/twine check --strict dist/*.whl dist/*.tar.gz

# Its tool has an environment of its own: what it needs is no part of an installation. After `make test` the
# list has the packages for development as well.
sbom: $(MAP_INSTALLED) $(SBOM_TOOLS)
	@mkdir -p dist
	$(SBOM_TOOLS) environment --pyproject pyproject.toml --mc-type library --output-format JSON \
		--output-file dist/v2hdm.cdx.json $(BIN)/python

$(SBOM_TOOLS):
	$(PYTHON) -m venv $(VENV)-sbom
	$(VENV)-sbom/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt cyclonedx-bom

clean:
	rm -rf $(VENV) $(VENV)-sbom build dist site v2hdm/native/_kernels* .mypy_cache .ruff_cache .pytest_cache .import_linter_cache

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed: make PYTHON=python3.12 ...")'
	$(PYTHON) -m venv $(VENV)
	$(INSTALL) --upgrade pip

# The kernels are compiled while what the package needs is chosen and unpacked.
define INSTALL_WITH
	@echo "installing into $(VENV): some minutes"
	$(BIN)/python .ci/needed.py $(1) >$(VENV)/needed-$(1).txt
	$(INSTALL) --no-deps -e . & $(INSTALL) -r $(VENV)/needed-$(1).txt && wait $$!
endef

$(MAP_INSTALLED): $(INSTALLED_FROM) | $(BIN)/python
	$(call INSTALL_WITH,map)
	@touch $@

# The development packages include those for mapping.
$(DEV_INSTALLED): $(INSTALLED_FROM) | $(BIN)/python
	$(call INSTALL_WITH,dev)
	@touch $(MAP_INSTALLED) $@
