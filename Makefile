# A bare machine needs Python 3.11 or later (with venv) and make: everything else is installed into .venv.
#   make demo      simulate a forest strip, run it, compare the result with the truth
#   make test      the fast tests          make slow   the others      make test-all   both
#   make papers    the tables and pictures of five papers on simulated data: papers.html
#   make bench     error against run time  make docs       the documentation as a site, in site/
#   make readers   other programs' LAS readers, from PyPI and npm as far as these have them, for `make test`
#   make bench BASE=REV                    run times of this checkout and of revision REV, in turn; more options of
#                  either, as --pulses or --scene: BENCH_OPTIONS="--scene open" (tests/bench/against.py, release.py)
#   make dist      wheels for Linux, macOS and Windows and the source distribution, in dist/: zig compiles for all
#   make figures   what README and docs print, made anew by their commands
#   make bench-real STRIP=...              a reference fit, halves, and injected echoes of real strips: bench/real.jsonl
#   make man       the manual pages, in build/man
#   make fuzz      damaged inputs of every kind, MINUTES=10 SEED=1; failures go to tests/fuzz_regressions.jsonl
#   make attack    signals to running commands and their workers at random instants, RUNS=1000 SEED=1
#   make lint      ruff, mypy              make clean      remove what was made

PYTHON ?= python3
KERNELS := $(wildcard wavebatch/kernels/c/*) wavebatch/kernels/build_kernels.py
VENV   := .venv
BIN    := $(VENV)/bin
DEMO   := demo
BENCH  := bench
MINUTES ?= 10
RUNS   ?= 1000
SEED   ?= 1

.PHONY: demo test slow test-all readers papers bench bench-real fuzz attack docs dist figures man lint clean
.DELETE_ON_ERROR:
# Without cached bytecode every process compiles all of its modules anew: a second each.
unexport PYTHONDONTWRITEBYTECODE

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "wavebatch needs Python 3.11 or later: make PYTHON=/path/to/python3.11" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.run: pyproject.toml $(KERNELS) | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	@touch $@

$(VENV)/.test: pyproject.toml $(KERNELS) | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[test]'
	@touch $@ $(VENV)/.run

$(VENV)/.plot: pyproject.toml $(KERNELS) | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[plot]'
	@touch $@ $(VENV)/.run

$(VENV)/.docs: pyproject.toml $(KERNELS) | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[docs]'
	@touch $@ $(VENV)/.run

demo: $(VENV)/.run
	@mkdir -p $(DEMO)
	$(BIN)/wavebatch simulate forest -o $(DEMO)/forest.laz --pulses 50000 --seed 1 --truth $(DEMO)/truth.npz --overwrite
	$(BIN)/wavebatch info $(DEMO)/forest.laz
	$(BIN)/wavebatch run $(DEMO)/forest.laz -o $(DEMO)/out --profile accurate --overwrite -v
	$(BIN)/wavebatch compare $(DEMO)/out/forest.laz --truth $(DEMO)/truth.npz
	@$(BIN)/wavebatch compare $(DEMO)/out/forest.laz --truth $(DEMO)/truth.npz --json > $(DEMO)/compare.json
	@$(BIN)/python examples/demo.py $(DEMO)

readers: $(VENV)/.test
	-$(BIN)/python -m pip install --quiet --disable-pip-version-check --only-binary :all: copclib
	-command -v npm >/dev/null && npm install --silent --no-save --no-audit --no-fund --prefix $(VENV)/npm \
	  copc@0.0.8 laz-perf@0.0.7 @loaders.gl/core@4.4.5 @loaders.gl/las@4.5.1

# A file at a time for each process: its strips and surveys are then made once. tests/conftest.py orders the files.
# Messages of compilers and names of files are those of a plain UTF-8 terminal, whatever the user's is.
PYTEST := LC_ALL=C.UTF-8 PYTHONUTF8=1 $(BIN)/python -m pytest -q -n auto --dist loadfile --no-loadscope-reorder

test: $(VENV)/.test
	@echo "The fast tests: about 3 minutes on 2 cores. A dot is a test; the share that is done stands at the right."
	$(PYTEST) -m 'not slow'

# Tests that fail run once more, because a busy machine may fail one by chance: red twice decides. Only where all tests
# have run (status 1): the second run says nothing of tests that the first did not reach.
SLOW := $(PYTEST) -m slow -o cache_dir=.pytest_cache/slow -o faulthandler_timeout=600

slow: $(VENV)/.test
	@echo "The slow tests: about 11 minutes on 2 cores. A dot is a test; the share that is done stands at the right."
	$(SLOW) --cache-clear || { [ $$? = 1 ] && \
	  echo "The tests named above were red once. Again; PASSED below is red by chance, FAILED decides:" && \
	  $(SLOW) --last-failed --last-failed-no-failures none -rpfE; }

test-all: test slow

papers: $(VENV)/.plot
	$(BIN)/python examples/papers/page.py -o papers.html

bench: $(VENV)/.test
	@rm -rf $(BENCH)/base $(BENCH)/source && mkdir -p $(BENCH)/source
ifdef BASE
	git archive $(BASE) | tar -x -C $(BENCH)/source
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --target $(BENCH)/base $(BENCH)/source
	@rm -rf $(BENCH)/source
	PYTHONPATH=tests $(BIN)/python -m bench.against $(BENCH)/base -o $(BENCH) $(BENCH_OPTIONS)
else
	-@$(BIN)/python -c 'import gdecomp' 2>/dev/null || $(BIN)/python -m pip install --quiet gdecomp
	PYTHONPATH=tests $(BIN)/python -m bench.release -o $(BENCH) $(BENCH_OPTIONS)
endif

bench-real: $(VENV)/.test
	@mkdir -p $(BENCH)
	$(BIN)/python tests/judging/real.py --strips "$(STRIP)" --classes $(SEED) --cache $(BENCH) -o $(BENCH)/real.jsonl

fuzz: $(VENV)/.test
	OPENBLAS_NUM_THREADS=1 $(BIN)/python tests/fuzzing.py --minutes $(MINUTES) --seed $(SEED)

attack: $(VENV)/.test
	OPENBLAS_NUM_THREADS=1 $(BIN)/python tests/attacking.py --runs $(RUNS) --seed $(SEED)

docs: $(VENV)/.docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict
	@echo "site: site/index.html; with its search: $(BIN)/python -m http.server --directory site"

dist: $(VENV)/.test
	$(BIN)/python -m pip install --quiet --disable-pip-version-check ziglang
	@rm -rf dist
	$(BIN)/python tests/wheels.py dist

figures: $(VENV)/.test
	OPENBLAS_NUM_THREADS=1 $(BIN)/python tests/printed_figures.py

man: $(VENV)/.test
	$(BIN)/wavebatch --man-pages build/man

lint: $(VENV)/.test
	$(BIN)/python -m ruff check .
	$(BIN)/python -m mypy

clean:
	rm -rf $(VENV) papers.html $(DEMO) $(BENCH) site build dist *.egg-info .pytest_cache .hypothesis .ruff_cache
	rm -rf wavebatch/kernels/_kernels.* wavebatch/kernels/.build-*
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
