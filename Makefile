# Every target is also a step of the automatic checks. `make` alone lists them.
# ARGS is handed on to the program behind a target: make test ARGS="-k density".

BIN := .venv/bin
PIP := -m pip --quiet --quiet --disable-pip-version-check
JOBS ?= 2
PROOFS ?= $(sort $(wildcard tests/prove_*.py))
LOCK_WITH := uv pip compile pyproject.toml --extra dev --extra label --extra ray --extra report --universal --python-version 3.11 --fork-strategy fewest \
	--only-binary :all: --no-binary rliable --generate-hashes --no-emit-index-url --no-emit-find-links

# Candidates are run, not only looked up: a version manager's stand-in can be on the path and refuse to start.
SUPPORTED := import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))
CHOOSE_PYTHON = python=; bare=; \
	for candidate in $(or $(PYTHON),python3.13 python3.12 python3.11 python3); do \
		"$$candidate" -c '$(SUPPORTED)' >/dev/null 2>&1 || continue; \
		"$$candidate" -c 'import venv, ensurepip' >/dev/null 2>&1 && python=$$candidate && break; \
		bare=$$candidate; \
	done; \
	if [ -z "$$python$$bare" ]; then \
		echo "error: $(if $(PYTHON),'$(PYTHON)' does not run as,found no) Python 3.11 to 3.13." >&2; exit 1; \
	elif [ -z "$$python" ]; then \
		echo "error: '$$bare' has no venv module (on Debian and Ubuntu: apt-get install python3-venv)." >&2; exit 1; \
	fi

.PHONY: help python install demo test check format bench prove lock clean

help:  ## print this list
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "  make %-9s%s\n", $$1, $$2 }' Makefile

python:  ## print the Python that .venv is made with (PYTHON=... chooses another)
	@$(CHOOSE_PYTHON); echo "$$python"

install: .venv/.installed  ## install the program and what it needs into .venv

.venv/.installed: requirements.lock pyproject.toml
	@$(BIN)/python -m pip --version >/dev/null 2>&1 \
		|| { $(CHOOSE_PYTHON); echo "Making .venv with $$python"; "$$python" -m venv --clear .venv; }
	@echo "Installing into .venv (1.7 GB; some minutes the first time)"
	@$(BIN)/python $(PIP) install --require-hashes -r requirements.lock
	@$(BIN)/python $(PIP) install --no-deps --no-build-isolation --editable .
	@touch $@

demo: install  ## train SENIOR on door-close with few labels, into a new directory under runs/, and judge it
	@out=runs/demo; n=1; while [ -e $$out ]; do n=$$((n + 1)); out=runs/demo-$$n; done; \
	set -ex; $(BIN)/senior train --task door-close --method m-senior --preset quick --out $$out $(ARGS); \
	$(BIN)/senior eval $$out --episodes 50

test: install  ## run the tests
	$(BIN)/python -m pytest -n $(JOBS) --dist worksteal $(ARGS)

check: install  ## check format, lint and types
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright

format: install  ## format the code and repair what lint can repair
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: install  ## measure the speed of this machine
	$(BIN)/senior bench $(ARGS)

prove: install  ## run the long proofs, which `test` leaves out (PROOFS=FILE for one)
	$(BIN)/python -m pytest --timeout 7200 $(PROOFS) $(ARGS)

lock:  ## pin the dependencies again (ARGS=--upgrade for the newest)
	@$(CHOOSE_PYTHON); "$$python" -m venv --clear build/lock
	@build/lock/bin/python $(PIP) install uv
	@PATH="$(CURDIR)/build/lock/bin:$$PATH" $(LOCK_WITH) $(ARGS) -o requirements.lock --quiet

clean:  ## remove .venv and everything built; runs/ is kept
	rm -rf .venv build dist .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
