# make demo   environment, then the demo: a mesh with a score in runs/demo   (make demo DEMO="--size small")
# make test   environment, then the tests                                    (make test PYTEST="-k mesh")
# make env    the environment alone, in .venv                                (make env PYTHON=/path/to/python3.12)
# make lint   the linters, the formats, the type checker, the order of packages
# make format every file in the form that make lint wants
# make wheel  sdist and wheel in dist, checked in a fresh environment without a compiler
# make browser-check   a report and a view in a headless Chromium (make browser-check PAGE=runs/demo/report.html)
# Nothing is done again unless what it depends on has changed.

PYTHON ?=
DEMO ?=
PYTEST ?=
PAGE ?=

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
CANDIDATES := python3.11 python3.12 python3.13 python3.14 python3
# One process per core, 8 at most: each of them holds torch.
WORKERS := from linprim_geo.base.cores import usable_cores; print(min(8, usable_cores()))
CPP := $(wildcard csrc/*.h csrc/*/*.h csrc/*/*.cpp)
CORE := CMakeLists.txt csrc $(wildcard csrc/*.h csrc/*/*)

.PHONY: env demo test lint format wheel browser-check clean

demo: env
	$(BIN)/python -m linprim_geo demo $(DEMO)

test: env
	$(BIN)/python -m pytest -q -n $$($(BIN)/python -c "$(WORKERS)") --dist worksteal $(PYTEST)

lint: env
	$(BIN)/ruff check .
	$(BIN)/ruff format --check -q .
	$(BIN)/clang-format --dry-run --Werror $(CPP)
	$(BIN)/mypy
	$(BIN)/python tools/check_imports.py

format: env
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/clang-format -i $(CPP)

wheel: env
	$(BIN)/python tools/check_wheel.py -o dist

browser-check: env
	$(BIN)/python tools/browser_check.py $(PAGE)

env: $(VENV)/.core

clean:
	rm -rf build dist $(VENV)/.core

# The stamps live in the environment, so that deleting .venv starts over.
$(VENV)/.checked: tools/check_system.py linprim_geo/base/system.py
	@set -e; \
	python="$(PYTHON)"; \
	if [ -z "$$python" ]; then for candidate in $(CANDIDATES); do \
	  if $$candidate -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; then \
	    python=$$candidate; break; fi; done; fi; \
	if [ -z "$$python" ]; then \
	  echo "make: no Python 3.11 or newer was found (tried $(CANDIDATES)): install one, or say make env PYTHON=..." >&2; \
	  exit 1; fi; \
	"$$python" tools/check_system.py; \
	if ! $(BIN)/python -c 'import pip' >/dev/null 2>&1; then \
	  if ! "$$python" -c 'import venv, ensurepip' >/dev/null 2>&1; then \
	    echo "make: $$python cannot make virtual environments: install its venv package (on Debian: apt-get install -y python3-venv)" >&2; \
	    exit 1; fi; \
	  echo "making $(VENV) with $$("$$python" -V)"; \
	  "$$python" -m venv --clear $(VENV); fi; \
	touch $@

$(VENV)/.installed: pyproject.toml constraints.txt $(VENV)/.checked
	@echo "installing the libraries into $(VENV) (some minutes the first time)"
	@$(PIP) install -qq -c constraints.txt scikit-build-core nanobind cmake ninja
	@$(BIN)/python -c "import tomllib; p = tomllib.load(open('pyproject.toml', 'rb'))['project']; \
	  o = p['optional-dependencies']; print('\n'.join(p['dependencies'] + o['test'] + o['dev']))" > $(VENV)/requirements.txt
	@$(PIP) install -qq -c constraints.txt -r $(VENV)/requirements.txt
	@touch $@

$(VENV)/.core: $(CORE) $(VENV)/.installed
	@echo "building the core"
	@PATH="$(CURDIR)/$(BIN):$$PATH" $(PIP) install -qq --no-build-isolation --no-deps -e .
	@$(BIN)/python -m nanobind.stubgen -q -m linprim_geo._core -o linprim_geo/_core.pyi
	@touch $@
