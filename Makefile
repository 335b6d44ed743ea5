# Sets itself up: needs only make and Python 3.11 or newer with its venv module.
#   make bowling    ten pins and a ball: frames, film and contact sheet in out/bowling
#                   (likewise falling, statues, room, teapots, figure, cloth, chess, sunlit)
#   make test       the tests            make check    ruff and pyright
#   make coverage   the tests, and which share of the lines outside kernels they run
#   make reference  the API reference, from the docstrings of the public names: out/reference/index.html
PYTHON ?= python3
BIN := .venv/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check

.PHONY: bowling falling statues room teapots figure cloth chess sunlit test coverage check reference clean
.DELETE_ON_ERROR:

bowling falling statues room teapots figure cloth chess sunlit: .venv/installed
	$(BIN)/python -m sims.$@ --out out/$@ $(ARGS)

test: .venv/installed-dev
	$(BIN)/python -m pytest $(ARGS)

coverage: .venv/installed-dev
	$(BIN)/python -m pytest --cov=warp_psf --cov-report=term $(ARGS)

check: .venv/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

reference: .venv/installed-dev
	rm -rf out/reference
	$(BIN)/python docs/reference.py out/reference

# The stamps follow one another, so that `make -j` never runs two installations into one environment.
.venv/created:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || \
	    { echo "warp_psf needs Python 3.11 or newer, which '$(PYTHON)' is not: name one with 'make PYTHON=python3.12'" >&2; exit 1; }
	@echo "Setting up .venv"
	@$(PYTHON) -m venv .venv
	@touch $@

.venv/installed: .venv/created pyproject.toml
	@echo "Installing warp_psf and what it needs"
	@$(PIP) --editable .
	@touch $@

.venv/installed-dev: .venv/installed
	@echo "Installing the test tools"
	@$(PIP) --editable '.[dev]'
	@touch $@

clean:
	rm -rf .venv out build dist *.egg-info test-failures .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
