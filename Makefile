# The README's two commands. Each does all of its own set-up in .venv (see tools/setup).
PYTHON ?= python3
SECONDS = 20
SEED = 7
OUT = out

.PHONY: demo test validation setup lint clean
demo:
	@PYTHON=$(PYTHON) tools/setup run
	@.venv/bin/vinesim demo --seconds $(SECONDS) --seed $(SEED) --out $(OUT) $(ARGS)

test: lint
	@.venv/bin/python -m pytest

validation: # figures and pictures of docs/validation.md, by the tests' own code
	@PYTHON=$(PYTHON) tools/setup test
	@PYTHONPATH=tests:tests/laws .venv/bin/python tests/laws/plots.py

lint:
	@PYTHON=$(PYTHON) tools/setup test
	@.venv/bin/ruff check .
	@.venv/bin/ruff format --check .
	@.venv/bin/lint-imports
	@.venv/bin/basedpyright --level error

clean:
	rm -rf .venv out
