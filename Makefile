# make demo and make test each do everything on a machine with nothing but Python 3.11 and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
OUT ?= runs/demo
export OMP_WAIT_POLICY = passive
# Many small systems are solved, in several processes at once: threads of each would wait for each other in circles.
export OPENBLAS_NUM_THREADS = 1
# Some hundred processes import the same modules: compiled once, for all of them.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: setup demo test test-slow fuzz mutants kill soak offline coverage docs dist lint format bench same ablation ablation-paper clean

setup: $(VENV)/.ready

$(VENV)/.ready: pyproject.toml constraints.txt
	@echo "$(VENV): fetching packages, then installing them (3.6 GB on disk): a few minutes"
	$(PYTHON) -m venv $(VENV)
	@while sleep 10 > /dev/null 2>&1; do echo "$(VENV): $$(du -sm $(VENV) | cut -f1) of some 3600 MB are installed"; done & beat=$$!; \
		trap 'kill $$beat' EXIT; $(BIN)/pip install --quiet -c constraints.txt -e ".[dev]"
	touch $@

demo: setup
	$(BIN)/lightdepth demo -o $(OUT) --overwrite

# One process a core; the tests of a file share their scenes, so they stay together.
test: setup
	$(BIN)/python -m pytest -n auto --maxprocesses 8 --dist loadfile

test-slow: setup
	$(BIN)/python -m pytest -m slow

# Spoilt files for every parser, each in a process with 1 GB: make fuzz SECONDS=600 PARSER="mask video". What fails is
# kept in tests/corpus. With the extra `fuzz` installed it is guided by the lines that inputs reach.
SECONDS ?= 60
PARSER ?=
fuzz: setup
	OMP_NUM_THREADS=1 $(BIN)/python tests/fuzz.py --seconds $(SECONDS) $(PARSER)

# Machine code counts no lines, so the tests of the compiled loops run once more with Numba off; all tests would take
# hours so. The floor stands in pyproject.toml.
LOOPS := $(patsubst %,tests/test_%.py,compiled coverage fusion marching marching_cubes patch_ncc rectify second_core)
coverage: setup
	$(BIN)/python -m pytest -n auto --maxprocesses 8 --dist loadfile --cov --cov-report= --cov-fail-under=0
	NUMBA_DISABLE_JIT=1 $(BIN)/python -m pytest -n auto --maxprocesses 8 --cov --cov-append \
		--cov-report=term:skip-covered $(LOOPS)

# Small faults planted in the numeric modules, and which of them the tests find (docs/mutants.md). About a quarter of
# an hour on one core for 300; what is already there is kept.
SEED ?= 1
COUNT ?= 300
mutants: setup
	PYTHONPATH=tests $(BIN)/python -m mutants --seed $(SEED) --count $(COUNT)

# Every verb killed at drawn events of the file system; hours. What was played is kept: make kill SEED=2 ONLY=predict,train
kill: setup
	$(BIN)/python tests/kill_matrix.py --seed $(or $(SEED),1) --only "$(ONLY)"

# 2000 keyframes live and 200 sequences in one process, every tenth failing: what grows? About five minutes of one core.
soak: setup
	OMP_NUM_THREADS=1 $(BIN)/python tests/soak.py

# The demo and the tests without network, home, name or a place to write packages: make offline WHAT="make demo"
WHAT ?=
offline: setup
	bash tests/offline.sh $(WHAT)

# A static site of README, docs/ and cards, in site/: nothing in it asks the network for anything.
docs: setup
	$(BIN)/mkdocs build --strict --quiet

# What is handed on, in dist/: an sdist with the site in it, to be read without a network, and a wheel from that.
dist: docs
	$(BIN)/python -m build

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: setup
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: setup
	$(BIN)/python -m pytest tests/benchmarks -o python_files='bench_*.py' -o addopts= -s

# Whether the working tree makes the same, byte for byte, as another revision: make same BASE=<revision>
same: setup
	$(BIN)/python tests/same_results.py $(BASE)

# About an hour and a quarter on one core; what is already there is kept.
ablation: setup
	$(BIN)/lightdepth ablate --config configs/ablation/lightdepth.yaml -o runs/ablation --table docs/ablation.md

# The same of the paper's preset: about two hours.
ablation-paper: setup
	$(BIN)/lightdepth ablate --config configs/ablation/paper.yaml -o runs/ablation-paper --table docs/ablation-paper.md

clean:
	rm -rf $(VENV) build dist site *.egg-info
