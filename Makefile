# Two commands do everything: `make demo` runs the whole pipeline, small, to a page with motions to watch;
# `make test` passes the tests. Each makes its own environment in .venv with pinned packages first.

PYTHON ?= python3
VENV ?= .venv
BIN := $(abspath $(VENV))/bin
STAMP := $(VENV)/installed
RECIPE ?= humantomato-tiny
DEMO_ARGS ?=
NUMERIC_TESTS := tests/models tests/datasets/motion

.PHONY: demo test test-numeric lint dist test-dist install clean help

help:
	@echo "make demo   whole pipeline on synthetic data, ends with the path of a page to watch"
	@echo "make test   the tests"
	@echo "make lint   ruff and mypy"
	@echo "make test-numeric   the numeric tests as older processors compute: AVX2 and none, one thread and two"
	@echo "make dist   sdist and wheel, in dist/"
	@echo "make test-dist   the wheel in an environment of its own, away from the tree"

install: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "motionloom needs Python 3.11 or newer; name one: make PYTHON=python3.12 demo"; exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip -c constraints.txt
	$(BIN)/python -m pip install --quiet -c constraints.txt --group dev -e '.[lora,remote,slurm]'
	@touch $(STAMP)

# On a CPU, two processes of one thread train these small networks faster than one of two threads, and do not slow
# down when others use the cores too. A GPU is used by as many processes as there are GPUs.
demo: $(STAMP)
	@$(BIN)/motionloom run $(RECIPE) --set hardware.cpu_devices=2 --set hardware.threads=1 $(DEMO_ARGS)

test: $(STAMP)
	$(BIN)/python -P -m pytest -n auto --maxprocesses 4 --dist loadfile $(PYTEST_ARGS)

# Sums are taken in another order there: a bound that only one processor keeps fails here. Both passes take one
# process: workers would need as much processor time for their imports as for the tests. Threads that wait passively
# leave the core to others.
test-numeric: $(STAMP)
	ATEN_CPU_CAPABILITY=avx2 ONEDNN_MAX_CPU_ISA=AVX2 OMP_NUM_THREADS=1 $(BIN)/python -P -m pytest -q -m numeric $(NUMERIC_TESTS)
	ATEN_CPU_CAPABILITY=default ONEDNN_MAX_CPU_ISA=AVX2 OMP_NUM_THREADS=2 OMP_WAIT_POLICY=passive $(BIN)/python -P -m pytest -q -m numeric $(NUMERIC_TESTS)

# mypy reads the folders as the namespace package `motionloom`, so it gets a folder of that name that links to them.
lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	@mkdir -p build/types/motionloom
	@for d in pipeline datasets models configs; do ln -sfn ../../../$$d build/types/motionloom/$$d; done
	cd build/types && MYPYPATH=. $(BIN)/mypy --config-file ../../pyproject.toml -p motionloom.datasets -p motionloom.models -p motionloom.pipeline -p motionloom.configs

# The wheel is built from the unpacked sdist: what the tree has beside it, old files in build/ too, is in neither.
dist: $(STAMP)
	rm -rf dist
	$(BIN)/python -P -c 'from setuptools import build_meta; build_meta.build_sdist("dist")' >/dev/null
	$(BIN)/python -m pip wheel --quiet --no-index --no-deps --no-build-isolation --wheel-dir dist dist/motionloom-*.tar.gz

test-dist: dist
	.ci/test-dist $(BIN) dist

clean:
	rm -rf build dist .pytest_cache .mypy_cache .ruff_cache
