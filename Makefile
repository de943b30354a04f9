# Two commands do everything: `make demo` runs the whole pipeline, small, to a page with motions to watch;
# `make test` passes the tests. Each makes its own environment in .venv with pinned packages first.

PYTHON ?= python3
VENV ?= .venv
BIN := $(abspath $(VENV))/bin
STAMP := $(VENV)/installed
RECIPE ?= humantomato-tiny
DEMO_ARGS ?=

FAST := not slow and not browser and not slurm

.PHONY: demo test test-all test-older lint dist test-dist install clean help

help:
	@echo "make demo   whole pipeline on synthetic data, ends with the path of a page to watch"
	@echo "make test   the tests, without the long ones; a few minutes"
	@echo "make test-all   all tests: trainings, kills, clusters and browsers too"
	@echo "make lint   ruff and mypy"
	@echo "make test-older   all tests as an older processor computes, without AVX-512"
	@echo "make dist   sdist and wheel, in dist/"
	@echo "make test-dist   the wheel in an environment of its own, away from the tree"

install: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "motionloom needs Python 3.11 or newer; name one: make PYTHON=python3.12 demo"; exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip -c constraints.txt
	$(BIN)/python -m pip install --quiet --no-compile -c constraints.txt --group dev -e '.[band,glb,remote,tensorboard]'
	@# pip compiles on one core what it installs. Templates among the packages are no Python.
	@$(BIN)/python -m compileall -qq -j 0 $(VENV)/lib >/dev/null || true
	@touch $(STAMP)

# On a CPU, two processes of one thread train these small networks faster than one of two threads, and do not slow
# down when others use the cores too. A GPU is used by as many processes as there are GPUs.
demo: $(STAMP)
	@$(BIN)/motionloom run $(RECIPE) --set hardware.cpu_devices=2 --set hardware.threads=1 $(DEMO_ARGS)

test: $(STAMP)
	$(BIN)/python -P -m pytest -n auto --maxprocesses 4 --dist loadfile -m "$(FAST)" $(PYTEST_ARGS)

# One process more than cores: a slow test waits for processes that it has started.
test-all: $(STAMP)
	@cores=$$(getconf _NPROCESSORS_ONLN); set -x; $(BIN)/python -P -m pytest \
	  -n $$((cores < 4 ? cores + 1 : 4)) --dist loadfile --no-loadscope-reorder $(PYTEST_ARGS)

# The tests as a processor with AVX2 and without AVX-512 computes: sums are taken in another order there, so a bound or a
# digest that only one kind of processor keeps fails here.
OLDER := NPY_DISABLE_CPU_FEATURES="X86_V4 AVX512_ICL AVX512_SPR" OPENBLAS_CORETYPE=Haswell NUMBA_CPU_NAME=haswell \
  ATEN_CPU_CAPABILITY=avx2 ONEDNN_MAX_CPU_ISA=AVX2 \
  GLIBC_TUNABLES=glibc.cpu.hwcaps=-AVX512F,-AVX512VL,-AVX512BW,-AVX512DQ,-AVX512CD

test-older: $(STAMP)
	@$(OLDER) $(MAKE) --no-print-directory test-all

# mypy reads this folder as the package `motionloom`, so it gets one of that name that links to what is in it.
lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	@mkdir -p build/types/motionloom
	@for d in pipeline datasets models configs __init__.py __init__.pyi; do ln -sfn ../../../$$d build/types/motionloom/$$d; done
	cd build/types && MYPYPATH=. $(BIN)/mypy --config-file ../../pyproject.toml -p motionloom

# The wheel is built from the unpacked sdist: what the tree has beside it, old files in build/ too, is in neither.
dist: $(STAMP)
	rm -rf dist
	$(BIN)/python -P -c 'from setuptools import build_meta; build_meta.build_sdist("dist")' >/dev/null
	$(BIN)/python -m pip wheel --quiet --no-index --no-deps --no-build-isolation --wheel-dir dist dist/motionloom-*.tar.gz

test-dist: dist
	.ci/test-dist $(BIN) dist

clean:
	rm -rf build dist .pytest_cache .mypy_cache .ruff_cache
