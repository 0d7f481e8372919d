# `make run` and `make test` do everything on a fresh machine with Python 3.11 or newer.
PYTHON ?= python3
VENV := .venv
ifeq ($(OS),Windows_NT)
BIN := $(VENV)/Scripts
else
BIN := $(VENV)/bin
endif

.DEFAULT_GOAL := help
.PHONY: help run serve test test-integrations lint bench soak fuzz damage inventory clean

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-17s %s\n", $$1, $$2}'

run: $(VENV)/.installed  ## train the tutorial's cooperative job, every step recorded
	$(BIN)/dualtaxi run configs/tutorial_cooperative.yaml
	@echo "        (for \`dualtaxi\` to be found: source $(BIN)/activate)"

serve: $(VENV)/.installed-service  ## open the runs in the browser
	$(BIN)/dualtaxi serve

# By name: where pytest finds a plugin in a package by itself, as in `runner`, it compiles all modules of that package again.
PLUGINS := $(addprefix -p ,xdist.plugin pytest_timeout _hypothesis_pytestplugin runner.golden.plugin)
# The tests start hundreds of processes: compile modules for them once.
test: export PYTHONDONTWRITEBYTECODE :=
# Else NumPy starts threads in each of them that wait busily.
test: export OPENBLAS_NUM_THREADS := 1
test: $(VENV)/.installed-dev  ## run all tests
	@$(BIN)/python -m compileall -q -j 0 dualtaxi runner
	$(BIN)/python -m pytest --disable-plugin-autoload $(PLUGINS) -n 3 --dist worksteal

test-integrations: $(VENV)-integrations/.installed  ## test the adapters against the real libraries (8 GB of them)
	$(VENV)-integrations/$(notdir $(BIN))/python -m pytest tests/integrations

lint: $(VENV)/.installed-dev  ## formatting, style, strict types and wording
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	@! git grep -nwiE -f .ci/forbidden-words -- '*.py' '*.md' '*.html' '*.js' '*.css' '*.yaml' \
		|| { echo 'Reword these lines: .ci/forbidden-words lists what this project does not write.'; exit 1; }

bench: $(VENV)/.installed-dev  ## measure what docs/performance.md states
	$(BIN)/python -m benchmarks

soak: $(VENV)/.installed-dev  ## kill 200 runs, then a server and its jobs 200 times, at random moments
	$(BIN)/python -m tests.reliability.soak --kills 200
	$(BIN)/python -m tests.reliability.jobs --kills 200

fuzz: $(VENV)/.installed-dev  ## feed the reader a million mutated recordings (Linux)
	$(BIN)/python -m pip install --constraint constraints.txt atheris
	$(BIN)/python -W ignore -m tests.reliability.fuzz --runs 1000000

damage: $(VENV)/.installed-dev  ## change 10,000 single bytes, each to be found by verify
	$(BIN)/python -m tests.reliability.damage

inventory: $(VENV)/.installed-dev  ## compare pages, commands, routes and names with what is written down
	$(BIN)/python -m tests.inventory

clean:  ## remove the environment and caches; recordings stay
	rm -rf $(VENV) $(VENV)-integrations build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	@echo 'Installing dualtaxi and its packages into $(VENV): a few minutes, once.'
	$(BIN)/python -m pip install --constraint constraints.txt --editable .
	touch $@

$(VENV)/.installed-service: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	@echo 'Installing dualtaxi with the service into $(VENV): a few minutes, once.'
	$(BIN)/python -m pip install --constraint constraints.txt --editable '.[service]'
	touch $@ $(VENV)/.installed

$(VENV)/.installed-dev: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	@echo 'Installing dualtaxi with all that the tests need into $(VENV): a few minutes, once.'
	$(BIN)/python -m pip install --constraint constraints.txt --editable '.[dev]'
	touch $@ $(VENV)/.installed $(VENV)/.installed-service

$(VENV)-integrations/.installed: pyproject.toml constraints-integrations.txt
	$(PYTHON) -m venv $(VENV)-integrations
	@echo 'Installing PyTorch, Ray, JAX and others into $(VENV)-integrations: ten minutes or more, once.'
	$(VENV)-integrations/$(notdir $(BIN))/python -m pip install \
		--constraint constraints-integrations.txt --editable '.[integrations]'
	touch $@
