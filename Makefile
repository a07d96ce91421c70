# Fresh machine with Python 3.11+ and make: `make demo`, `make test`.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: demo test check unit net cov test-uncompiled test-oldest journey clean
demo: $(STAMP)
	$(BIN)/armscan demo single -o demo

test: check unit

check: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

unit: $(STAMP)
	$(BIN)/pytest -n 2 --dist worksteal

# every command on small inputs against what it wrote before, to 1e-9: for the machine of golden/
net: $(STAMP)
	$(BIN)/python tests/net/run.py compare

# lines that tests reach; compiled kernels cannot be traced and are left out
cov: $(STAMP)
	$(BIN)/pytest -n 2 --dist worksteal --cov --cov-report=term:skip-covered

# the kernels' tests as plain Python: an index beyond an array raises there, compiled it does not
KERNEL_TESTS := tests/unit/stripe/test_kernels.py tests/unit/test_jpeg_format.py
test-uncompiled: $(STAMP)
	NUMBA_DISABLE_JIT=1 $(BIN)/pytest -n 2 $(KERNEL_TESTS)

# from an empty folder to a report in the console's page, by its buttons alone, in Chromium
journey: $(STAMP)
	ARMSCAN_JOURNEY=1 $(BIN)/pytest tests/system/test_console_in_browser.py

# the oldest series of each dependency that pyproject.toml allows
OLDEST := .venv-oldest
test-oldest:
	$(PYTHON) -m venv $(OLDEST)
	$(OLDEST)/bin/python -c "import tomllib; print(*(d.replace('>=', '==') + '.*' for d in \
	  tomllib.load(open('pyproject.toml', 'rb'))['project']['dependencies']), sep='\n')" > $(OLDEST)/oldest.txt
	$(OLDEST)/bin/python -m pip install -q --disable-pip-version-check -e . -c $(OLDEST)/oldest.txt \
	  pytest pytest-xdist hypothesis
	$(OLDEST)/bin/pytest -n 2 --dist worksteal tests/unit tests/smoke tests/net

$(STAMP): pyproject.toml
	@if command -v uv >/dev/null 2>&1; then uv venv -q --allow-existing --python $(PYTHON) $(VENV) && uv pip install -q --python $(BIN)/python -e '.[dev]'; \
	else $(PYTHON) -m venv $(VENV) && $(BIN)/python -m pip install -q --disable-pip-version-check -e '.[dev]'; fi
	@touch $(STAMP)

clean:
	rm -rf $(VENV) $(OLDEST) demo
