# Two commands do everything on a fresh machine: `make demo` and `make test`.
VENV ?= .venv
PYTHON ?= $(shell for p in python3.11 python3.12 python3.13 python3.14 python3.10 python3; do \
	$$p -c 'import sys; sys.exit(not (3, 10) <= sys.version_info < (3, 15))' 2>/dev/null && echo $$p && break; done)
BIN := $(VENV)/bin
READY := $(VENV)/.ready
# All packages are resolved together, so that none brings another build of torch.
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt --group dev --group docs
# Idle OpenMP threads would spin on the cores Dr.Jit needs.
export OMP_WAIT_POLICY ?= passive

.PHONY: setup demo test test-all stress lint format bench bench-quick docs bake clean

setup: $(READY) llvm

$(READY): pyproject.toml drjit_splat/pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "Python 3.10 to 3.14 is needed; set PYTHON=/path/to/python"; exit 1; }
	@echo "installing into $(VENV): some minutes, about 3 GB"
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check 'pip>=25.1'  # knows dependency groups
	$(INSTALL) -e ./drjit_splat -e '.[all]'
	@touch $@

.PHONY: llvm
llvm: $(READY)
	@$(BIN)/python -m tools.setup_llvm

.PHONY: chromium
chromium: $(READY)
	@$(BIN)/python -m tools.setup_chromium

.PHONY: node
node: $(READY)
	@$(BIN)/python -m tools.setup_node

demo: setup
	$(BIN)/uika demo -o out/demo

test: setup chromium node
	$(BIN)/python -m pytest -q

# Ten thousand random scenes, 200 extreme ones, 100,000 damaged files, stopped commands: hours. Goes on where it was stopped.
stress: setup
	for name in extreme gradients scenes fuzz; do $(BIN)/python -m tests.stress.campaign $$name || exit 1; done
	UIKA_STRESS=long UIKA_STRESS_TABLE=out/stress/tests.json $(BIN)/python -m pytest -q -m "slow or not slow" \
		tests/stress tests/photo/test_read.py tests/train/test_train.py
	$(BIN)/python -m tests.stress.report
	$(BIN)/python tools/readme_figures.py

test-all: setup chromium node
	$(BIN)/python -m pytest -q -m "slow or not slow"

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: setup
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# With nothing else on the machine: they measure time.
bench: setup
	$(BIN)/python -m benchmarks
	$(BIN)/python -m benchmarks.summary
	$(BIN)/python tools/readme_figures.py

# Shows that every benchmark runs, in some minutes.
bench-quick: setup
	$(BIN)/python -m benchmarks --quick

docs: setup
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build

bake: setup
	$(INSTALL) -e ./drjit_splat -e '.[all,bake]'
	$(BIN)/python tools/bake_head.py

clean:
	rm -rf $(VENV) out build dist .pytest_cache .mypy_cache .ruff_cache
