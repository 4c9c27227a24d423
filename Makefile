# The README's two commands are `make demo` and `make test`. Each does its own set-up in .venv (see tools/setup).
PYTHON ?= python3
SECONDS = 20
SEED = 7
OUT = out
JOBS = 2
PYTEST = .venv/bin/python -m pytest -n $(JOBS) --dist loadgroup

LINT = .venv-lint/bin
BIOME = .venv-lint/node_modules/.bin/biome

.PHONY: demo test test-long check lint docs wheel release validation setup clean
demo:
	@PYTHON=$(PYTHON) tools/setup run
	@.venv/bin/vinesim demo --seconds $(SECONDS) --seed $(SEED) --out $(OUT) $(ARGS)

test: setup lint # lint, types and the tests of every claim
	@$(PYTEST)

test-long: setup # what make test leaves out: more seeds and examples, soaks, notebooks, more pages in a browser
	@$(PYTEST) -m "long or hypothesis" --hypothesis-profile test-long

check: setup lint # lint, types, structure and the fast tests
	@$(PYTEST) -m "not slow and not long"

lint: # needs pip only; types of more packages are known where .venv is there
	@PYTHON=$(PYTHON) tools/setup lint
	@$(LINT)/ruff check .
	@$(LINT)/ruff format --check .
	@$(LINT)/lint-imports
	@if [ -x $(BIOME) ]; then $(BIOME) check; \
	  else echo "npm is missing: the page's JavaScript is not checked; install Node.js, and remove .venv-lint"; fi
	@$(LINT)/basedpyright --level error --pythonpath $(firstword $(wildcard .venv/bin/python) $(LINT)/python)

setup:
	@PYTHON=$(PYTHON) tools/setup test

docs: setup # the documentation site, into build/site
	@NO_MKDOCS_2_WARNING=1 .venv/bin/python -m mkdocs build --strict --quiet

wheel: # what pip installs, into build/wheel
	@$(PYTHON) -m pip wheel --quiet --disable-pip-version-check --no-deps --wheel-dir build/wheel .

release: setup # what is published, into build/release: wheel and sdist, checked
	@rm -rf build/release
	@.venv/bin/python -m hatchling build --directory build/release
	@.venv/bin/python -m twine check --strict build/release/*

validation: setup # figures and pictures of docs/validation.md, by the tests' own code
	@.venv/bin/python -m tests.laws.plots

clean:
	rm -rf .venv .venv-lint out
